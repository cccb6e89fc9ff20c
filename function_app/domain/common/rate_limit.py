"""Rate limiting with the generic cell rate algorithm, whose whole state is one timestamp.

Each request advances a theoretical arrival time. A request that is further ahead of the clock than a burst allows must
wait (ATM Forum, Traffic Management 4.0, 1996). Existing libraries store the state in Redis or run their own threads.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate per second and a burst size. ``per_s`` 0: no limit."""

    per_s: float
    burst: int


def request(rate: Rate, arrival_ms: float, now_ms: float) -> tuple[float, float]:
    """Admit or delay one request.

    Args:
        rate: The limit.
        arrival_ms: First value of the previous result; 0 initially.
        now_ms: Current time. A clock that jumps back delays requests by at most one burst.

    Returns:
        The new arrival time, and the time to wait [ms]; 0: the request is admitted.
    """
    if rate.per_s <= 0:
        return 0.0, 0.0
    each_ms = 1000 / rate.per_s
    ahead_ms = each_ms * rate.burst
    arrival_ms = min(max(arrival_ms, now_ms), now_ms + ahead_ms)
    if arrival_ms + each_ms > now_ms + ahead_ms:
        return arrival_ms, arrival_ms + each_ms - now_ms - ahead_ms
    return arrival_ms + each_ms, 0.0
