"""Delays between connection attempts, shared by all transports."""

import random
import time

MIN_S = 0.2
MAX_S = 15.0


class BackOff:
    """Delays that double with each attempt, and restart after a stable link.

    Full jitter prevents agents that lost one server together from reconnecting together.
    """

    def __init__(self) -> None:
        self._next_s = MIN_S
        self._started_s = time.monotonic()

    def attempt(self) -> None:
        """Record the start of an attempt."""
        self._started_s = time.monotonic()

    def wait_s(self) -> float:
        """Delay after the attempt, or the link that resulted from it, has ended [s]."""
        if time.monotonic() - self._started_s > MAX_S:
            self._next_s = MIN_S
        longest_s, self._next_s = self._next_s, min(2 * self._next_s, MAX_S)
        return random.uniform(MIN_S / 2, longest_s)  # noqa: S311 (not a secret)
