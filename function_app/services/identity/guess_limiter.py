"""How often something was tried in vain: what can be guessed is given few tries."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from function_app.domain.common.problems import Problem
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.storage import records
from function_app.services.storage.retention import Retention


@dataclass(frozen=True, slots=True)
class Guess:
    """What is tried.

    Attributes:
        what: Names it in the rows.
        window_ms: For so long a wrong try counts.
        refusal: Of one too many: a sentence, to go before "Try again in …".
    """

    what: str
    window_ms: int
    refusal: str


@dataclass(frozen=True, slots=True)
class _Tries:
    since_ms: int
    count: int
    expires_ms: int


class GuessLimiter:
    """Counts tries by whom or whence they come. Right ones are taken back, so only wrong ones count."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock

    async def add_failure(self, guess: Guess, counters: Mapping[str, int]) -> None:
        """Count a try before looking, so that parallel guesses are no way around.

        Args:
            guess: What is tried.
            counters: By what it is counted, and how many wrong tries each allows in a window.

        Raises:
            Problem: ``too-many-tries`` by one of them; such a try counts nowhere.
        """
        done: dict[str, int] = {}
        for counter, most in counters.items():
            try:
                await self._change(guess, counter, 1, most)
            except Problem:
                await self.remove_failure(guess, done)
                raise
            done[counter] = most

    async def remove_failure(self, guess: Guess, counters: Mapping[str, int]) -> None:
        """Take a try back: it was right."""
        for counter, most in counters.items():
            await self._change(guess, counter, -1, most)

    async def _change(self, guess: Guess, counter: str, change: int, most: int) -> None:
        now_ms = self._clock.now_ms()

        def counted(tries: _Tries | None) -> _Tries:
            if tries is None or now_ms - tries.since_ms >= guess.window_ms:
                tries = _Tries(now_ms, 0, now_ms + guess.window_ms)
            if change > 0 and tries.count >= most:
                wait_s = -(-(tries.since_ms + guess.window_ms - now_ms) // 1000)
                detail = f"{guess.refusal} Try again in {wait_s} s."
                raise Problem("too-many-tries", 429, "Too many tries", detail, retry_after_s=wait_s)
            return replace(tries, count=max(0, tries.count + change))

        # One note for all tries of a while, and written first: nothing stays that nobody forgets.
        due_ms = (now_ms // guess.window_ms + 2) * guess.window_ms
        await self._retention.delete_row_at(records.ATTEMPTS, counter, guess.what, due_ms=due_ms)
        await records.upsert(self._tables, records.ATTEMPTS, counter, guess.what, counted, _Tries)


def by_address(address: str, most: int) -> dict[str, int]:
    """The counter of the address that a request comes from; none where nothing tells it."""
    return {f"address:{address}": most} if address else {}
