"""Concurrent appends to blobs in stores that replace whole objects."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from weakref import WeakValueDictionary

from function_app.ports.tables import StoreError

TRIES = 30
"""Attempts of an append that conflicts with writes of other instances to the same blob."""
_PAUSE_S = 0.01
_LONGEST_PAUSE_S = 0.2


class Appends:
    """Serializes the appends of this process per blob, and retries appends that conflict with another process."""

    def __init__(self) -> None:
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    async def run(self, name: str, append: Callable[[], Awaitable[bool]]) -> None:
        """Call ``append`` until it returns ``True``; ``False`` means that another process wrote the blob.

        Raises:
            StoreError: All attempts conflicted.
        """
        async with self._locks.setdefault(name, asyncio.Lock()):
            for attempt in range(TRIES):
                if await append():
                    return
                await pause(attempt)
        raise StoreError(f"too many concurrent appends to the blob '{name}'. Try again.")


async def pause(attempt: int) -> None:
    """Exponential backoff with jitter."""
    pause_s = min(_PAUSE_S * 2**attempt, _LONGEST_PAUSE_S)
    await asyncio.sleep(random.uniform(0, pause_s))  # noqa: S311 (spreads writers)
