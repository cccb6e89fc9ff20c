"""Rate limits by address, account, API key and agent. ``guess_limiter`` protects secrets.

Each process counts in memory without table requests: n instances admit up to n times as many requests.
"""

import math
from collections import OrderedDict
from typing import Final, Literal

from function_app.domain.common.problems import Problem
from function_app.domain.common.rate_limit import Rate, request
from function_app.ports.clock import Clock

BURST_S: Final = 20
"""Burst size in seconds of the rate: opening a page sends many requests."""
KNOWN: Final = 50_000
"""Number of remembered names (5 MB)."""

Kind = Literal["address", "account", "key", "agent"]
_WHOSE: Final = {"address": "this address", "account": "this account", "key": "this API key", "agent": "this agent"}


class RateLimiter:
    """Counts requests."""

    def __init__(self, *, per_s: dict[Kind, int], clock: Clock) -> None:
        self._rates = {kind: Rate(rate, rate * BURST_S) for kind, rate in per_s.items()}
        self._clock = clock
        self._arrivals: OrderedDict[tuple[Kind, str], float] = OrderedDict()

    def admit(self, kind: Kind, name: str) -> None:
        """Count one request. Raises ``too-many-requests``."""
        key = (kind, name)
        arrival_ms, wait_ms = request(self._rates[kind], self._arrivals.get(key, 0.0), self._clock.now_ms())
        self._arrivals[key] = arrival_ms
        self._arrivals.move_to_end(key)
        if len(self._arrivals) > KNOWN:
            self._arrivals.popitem(last=False)
        if wait_ms > 0:
            wait_s = math.ceil(wait_ms / 1000)
            detail = f"Too many requests from {_WHOSE[kind]}. Try again in {wait_s} s."
            raise Problem("too-many-requests", 429, "Too many requests", detail, retry_after_s=wait_s)
