"""How often somebody may ask: the generic cell rate algorithm, whose whole state is one time.

Each request pushes a theoretical arrival time on by the time that it is worth; who is further ahead of the clock than a
burst allows has to wait. Written here in ten lines because libraries for it keep their state in Redis or threads of
their own, and all there is to keep is a number (ATM Forum, Traffic Management 4.0, 1996).
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Rate:
    """So many a second, and so many at once after a rest. ``per_s`` 0: any number."""

    per_s: float
    burst: int


def request(rate: Rate, arrival_ms: float, now_ms: float) -> tuple[float, float]:
    """Judge one request.

    Args:
        rate: What is allowed.
        arrival_ms: What the last call gave; 0 at first.
        now_ms: The time. One that jumps back locks nobody out for longer than a burst takes.

    Returns:
        The new arrival time, and how long to wait [ms]: 0 where the request is let through.
    """
    if rate.per_s <= 0:
        return 0.0, 0.0
    each_ms = 1000 / rate.per_s
    ahead_ms = each_ms * rate.burst
    arrival_ms = min(max(arrival_ms, now_ms), now_ms + ahead_ms)
    if arrival_ms + each_ms > now_ms + ahead_ms:
        return arrival_ms, arrival_ms + each_ms - now_ms - ahead_ms
    return arrival_ms + each_ms, 0.0
