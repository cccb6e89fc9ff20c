"""How long to wait before the next attempt to connect. Shared by all transports."""

import random
import time

FIRST_S = 0.2
LONGEST_S = 15.0


class BackOff:
    """Waits that double from attempt to attempt, and begin anew after a link that held.

    Full jitter: agents that lost one server together do not come back together.
    """

    def __init__(self) -> None:
        self._next_s = FIRST_S
        self._began_s = time.monotonic()

    def attempt(self) -> None:
        """An attempt begins."""
        self._began_s = time.monotonic()

    def wait_s(self) -> float:
        """How long to wait now that the attempt, or the link that came of it, has ended [s]."""
        if time.monotonic() - self._began_s > LONGEST_S:
            self._next_s = FIRST_S
        longest_s, self._next_s = self._next_s, min(2 * self._next_s, LONGEST_S)
        return random.uniform(FIRST_S / 2, longest_s)  # noqa: S311 (not a secret)
