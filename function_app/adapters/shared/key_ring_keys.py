"""``SigningKeys`` of a key ring, independent of its storage."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from device_agent.protocol.security import signing
from function_app.adapters.shared import key_ring
from function_app.adapters.shared.key_ring import Ring, RingKey
from function_app.ports.signing_keys import LEARN_MS, OVERLAP_MS, KeyAnnouncement, PinnedKey


def wall_ms() -> int:
    """The machine's wall clock [ms since 1970]."""
    return time.time_ns() // 1_000_000


class RingKeys(ABC):
    """``SigningKeys`` of a key ring. Overlaps end by the wall clock ``now_ms``."""

    def __init__(self, *, now_ms: Callable[[], int] = wall_ms) -> None:
        self._now_ms = now_ms
        self._privates: dict[str, Ed25519PrivateKey] = {}

    async def current(self) -> Ed25519PrivateKey:
        return self._private((await self._ring()).newest)

    async def for_devices(self) -> Ed25519PrivateKey:
        return self._private((await self._ring()).for_devices(self._now_ms()))

    async def public(self, wanted: str = "") -> Mapping[str, Ed25519PublicKey]:
        keys = key_ring.public((await self._ring()).valid(self._now_ms()))
        if wanted and wanted not in keys:
            keys = key_ring.public((await self._ring(refresh=True)).valid(self._now_ms()))
        return keys

    async def archive(self) -> Mapping[str, Ed25519PublicKey]:
        return key_ring.public(tuple(key for key in (await self._ring()).keys if not key.leaked))

    async def announcement(self) -> KeyAnnouncement:
        return self._announcement(await self._ring())

    async def rotate(
        self, *, learn_ms: int = LEARN_MS, overlap_ms: int = OVERLAP_MS, leaked: bool = False
    ) -> KeyAnnouncement:
        new, now_ms = signing.generate(), self._now_ms()

        def change(ring: Ring) -> Ring:
            if leaked:
                return ring.replaced(new, now_ms=now_ms)
            return ring.rotated(new, now_ms=now_ms, learn_ms=learn_ms, overlap_ms=overlap_ms)

        return self._announcement(await self._change(change))

    async def close(self) -> None:  # noqa: B027 (optional to override)
        """See ``SigningKeys``."""

    def signer(self) -> Ed25519PrivateKey:
        """``current`` from the cache, for synchronous callers.

        Raises:
            StoreError: The keys cannot be read or have not been read yet.
        """
        return self._private(self._cached().newest)

    def secrets(self) -> tuple[bytes, ...]:
        """The stored private keys, newest first, so that values derived from them remain valid after a rotation.

        Raises:
            StoreError: See ``signer``.
        """
        return tuple(self._private(key).private_bytes_raw() for key in reversed(self._cached().keys) if key.private)

    @abstractmethod
    def _cached(self) -> Ring:
        """The cached ring.

        Raises:
            StoreError: The ring cannot be read or has not been read yet.
        """

    @abstractmethod
    async def _ring(self, *, refresh: bool = False) -> Ring:
        """The current ring, possibly from the cache; ``refresh`` reads it again, at a limited rate."""

    @abstractmethod
    async def _change(self, change: Callable[[Ring], Ring]) -> Ring:
        """Write the result of ``change``, and return it."""

    def _announcement(self, ring: Ring) -> KeyAnnouncement:
        now_ms = self._now_ms()
        pins = tuple(
            PinnedKey(key.id, signing.public_key(key.public), key.serial, key.until_ms) for key in ring.valid(now_ms)
        )
        return KeyAnnouncement(pins, ring.statements(now_ms), ring.for_devices(now_ms).id)

    def _private(self, key: RingKey) -> Ed25519PrivateKey:
        if key.public not in self._privates:
            self._privates[key.public] = key_ring.private(key)
        return self._privates[key.public]
