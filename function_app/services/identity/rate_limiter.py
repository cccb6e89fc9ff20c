"""Rates by address, account, API key and agent. Guards the functions, not secrets: for these see ``claim.py``.

Each process counts for itself and writes nothing, so that a limit costs microseconds and never a request to the
tables: of n instances all together let through n times as much. What is guessed at is counted in the tables instead.
"""

import math
from collections import OrderedDict
from typing import Final, Literal

from function_app.domain.common.problems import Problem
from function_app.domain.common.rate_limit import Rate, request
from function_app.ports.clock import Clock

BURST_S: Final = 20
"""So many seconds' worth may come at once: a page that opens asks for everything it shows."""
KNOWN: Final = 50_000
"""Of so many names the newest are remembered (5 MB)."""

Kind = Literal["address", "account", "key", "agent"]
_WHOSE: Final = {"address": "this address", "account": "this account", "key": "this API key", "agent": "this agent"}


class RateLimiter:
    """Counts requests."""

    def __init__(self, *, per_s: dict[Kind, int], clock: Clock) -> None:
        self._rates = {kind: Rate(rate, rate * BURST_S) for kind, rate in per_s.items()}
        self._clock = clock
        self._arrivals: OrderedDict[tuple[Kind, str], float] = OrderedDict()

    def admit(self, kind: Kind, name: str) -> None:
        """Count one request.

        Raises:
            Problem: ``too-many-requests``.
        """
        key = (kind, name)
        arrival_ms, wait_ms = request(self._rates[kind], self._arrivals.get(key, 0.0), self._clock.now_ms())
        self._arrivals[key] = arrival_ms
        self._arrivals.move_to_end(key)
        if len(self._arrivals) > KNOWN:
            self._arrivals.popitem(last=False)
        if wait_ms > 0:
            wait_s = math.ceil(wait_ms / 1000)
            detail = f"More requests come from {_WHOSE[kind]} than are answered here. Try again in {wait_s} s."
            raise Problem("too-many-requests", 429, "Too many requests", detail, retry_after_s=wait_s)
