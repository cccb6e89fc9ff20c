"""Limits failed attempts for guessable secrets."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from function_app.domain.common.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.storage import records
from function_app.services.storage.retention import Retention


@dataclass(frozen=True, slots=True)
class Guess:
    """A guessable secret: its name in rows, how long a failure counts, and the text before "Try again in …"."""

    what: str
    window_ms: int
    refusal: str


@dataclass(frozen=True, slots=True)
class _Tries:
    since_ms: int
    count: int
    expires_ms: int


class GuessLimiter:
    """Counts attempts by account or address. Successful attempts are removed from the count."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock

    async def add_failure(self, guess: Guess, counters: Mapping[str, int]) -> int:
        """Count an attempt before it is checked, so that parallel attempts cannot bypass the limit.

        ``counters`` maps each counter to the failures that it allows per window. Returns the count of the last one.
        Raises ``too-many-tries``; such an attempt is not counted.
        """
        count = 0
        done: dict[str, int] = {}
        for counter, most in counters.items():
            try:
                count = await self._change(guess, counter, 1, most)
            except Problem:
                await self.remove_failure(guess, done)
                raise
            done[counter] = most
        return count

    async def remove_failure(self, guess: Guess, counters: Mapping[str, int]) -> None:
        """Remove a successful attempt from the count."""
        for counter, most in counters.items():
            await self._change(guess, counter, -1, most)

    async def _change(self, guess: Guess, counter: str, change: int, most: int) -> int:
        now_ms = self._clock.now_ms()

        def counted(tries: _Tries | None) -> _Tries:
            if tries is None or now_ms - tries.since_ms >= guess.window_ms:
                tries = _Tries(now_ms, 0, now_ms + guess.window_ms)
            if change > 0 and tries.count >= most:
                wait_s = -(-(tries.since_ms + guess.window_ms - now_ms) // 1000)
                detail = f"{guess.refusal} Try again in {wait_s} s."
                raise Problem("too-many-tries", 429, "Too many tries", detail, retry_after_s=wait_s)
            return replace(tries, count=max(0, tries.count + change))

        # One deletion per window, scheduled before the row is written.
        due_ms = (now_ms // guess.window_ms + 2) * guess.window_ms
        await self._retention.delete_row_at(records.ATTEMPTS, counter, guess.what, due_ms=due_ms)
        tries = await records.upsert(self._tables, records.ATTEMPTS, counter, guess.what, counted, _Tries)
        return tries.count if tries else 0


def by_address(address: str, most: int) -> dict[str, int]:
    """The counter of the client's address; empty if unknown."""
    return {f"address:{address}": most} if address else {}
