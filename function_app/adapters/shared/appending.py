"""Appends to blobs of stores that replace whole objects, while others write to the same blob."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from weakref import WeakValueDictionary

from function_app.ports.tables import StoreError

TRIES = 30
"""How often an append starts again because another instance has written to the same blob in the meantime."""
_PAUSE_S = 0.01
_LONGEST_PAUSE_S = 0.2


class Appends:
    """Lets the appends of one process to a blob take turns, and repeats those that another process disturbed."""

    def __init__(self) -> None:
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    async def run(self, name: str, append: Callable[[], Awaitable[bool]]) -> None:
        """Call ``append`` until it returns ``True``: ``False`` means that another process wrote the blob meanwhile.

        Raises:
            StoreError: Other processes write all the time.
        """
        async with self._turns.setdefault(name, asyncio.Lock()):
            for attempt in range(TRIES):
                if await append():
                    return
                await pause(attempt)
        raise StoreError(f"too many append to the blob '{name}' at once. Try again.")


async def pause(attempt: int) -> None:
    """Wait for a random time that grows with the number of attempts, so that writers do not meet again."""
    pause_s = min(_PAUSE_S * 2**attempt, _LONGEST_PAUSE_S)
    await asyncio.sleep(random.uniform(0, pause_s))  # noqa: S311 (spreads writers)
