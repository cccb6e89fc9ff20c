"""Signing keys in memory."""

from collections.abc import Callable

from device_agent.protocol.security import signing
from function_app.adapters.shared.key_ring import Ring
from function_app.adapters.shared.key_ring_keys import RingKeys, wall_ms


class MemorySigningKeys(RingKeys):
    """``Keys`` in memory."""

    def __init__(self, *, now_ms: Callable[[], int] = wall_ms) -> None:
        super().__init__(now_ms=now_ms)
        self._stored = Ring.first(signing.generate())

    async def _ring(self, *, refresh: bool = False) -> Ring:
        del refresh
        return self._cached()

    async def _change(self, change: Callable[[Ring], Ring]) -> Ring:
        self._stored = change(self._stored)
        return self._cached()

    def _cached(self) -> Ring:
        self._stored = self._stored.pruned(self._now_ms())
        return self._stored
