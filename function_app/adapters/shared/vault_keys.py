"""``SigningKeys`` of a ring that is one secret of a cloud's vault.

Why a secret and no key of the vault's own: Azure's Key Vault has no Ed25519 among its key types (P-256, P-256K, P-384,
P-521, RSA). Amazon's KMS has it since 2025, but signs at most 4,096 bytes, where an order with a script has 64 KB, and
each order and token would wait for a call. The vault keeps the secret encrypted, says who may read it, and logs it.

The functions only read. ``python -m function_app prepare`` creates the secret and ``rotate-keys`` changes it, with the
rights of the person who deploys. Two concurrent runs are detected only as far as the vault supports it.
"""

import asyncio
import logging
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

from device_agent.protocol.security import signing
from function_app.adapters.shared.key_ring import Ring, RingError
from function_app.adapters.shared.key_ring_keys import RingKeys, wall_ms
from function_app.ports.tables import StoreError

LOOK_EVERY_MS = 60_000
"""How long a process goes on with what it has read: less than what devices are given to learn a key."""
AGAIN_MS = 5_000
"""Minimum time between two reads for unknown keys: any client can send an unknown key id."""
_log = logging.getLogger(__name__)


class Secret(NamedTuple):
    """What the vault holds, and which version of it."""

    text: str
    version: str


class VaultKeys(RingKeys):
    """``SigningKeys`` in a vault; errors name the secret as ``what``."""

    def __init__(self, *, what: str, now_ms: Callable[[], int] = wall_ms) -> None:
        super().__init__(now_ms=now_ms)
        self._what = what
        self._read: Ring | None = None
        self._read_ms = 0
        self._turn = asyncio.Lock()

    async def prepare(self) -> None:
        """Make the secret, with a first key, where there is none. Safe to repeat.

        Raises:
            StoreError: It cannot be made.
        """
        if await self._fetch() is None:
            await self._create(Ring.first(signing.generate()).text)

    @abstractmethod
    async def _fetch(self) -> Secret | None:
        """What the vault holds now; ``None`` where there is no such secret.

        Raises:
            StoreError: It does not say.
        """

    @abstractmethod
    async def _create(self, text: str) -> None:
        """Create the secret. If another process creates it at the same time, either one may remain."""

    @abstractmethod
    async def _put(self, text: str) -> None:
        """A new version of the secret."""

    def _known(self) -> Ring:
        if self._read is None:
            raise StoreError(f"{self._what} has not been read yet")
        return self._read

    async def _ring(self, *, fresh: bool = False) -> Ring:
        async with self._turn:
            age_ms = self._now_ms() - self._read_ms
            if self._read is None or not 0 <= age_ms < (AGAIN_MS if fresh else LOOK_EVERY_MS):
                await self._look()
            return self._known()

    async def _look(self) -> None:
        """Read it; what was read before stays in force while the vault does not answer."""
        self._read_ms = self._now_ms()
        try:
            self._read = self._parse(await self._fetch())
        except StoreError as error:
            if self._read is None:
                raise
            _log.warning("%s; the keys from before stay in force", error)

    async def _change(self, change: Callable[[Ring], Ring]) -> Ring:
        before = await self._fetch()
        ring = change(self._parse(before))
        if await self._fetch() != before:
            raise StoreError(f"{self._what} was changed by another process at the same time. Check it, and try again.")
        await self._put(ring.text)
        async with self._turn:
            self._read, self._read_ms = ring, self._now_ms()
        return ring

    def _parse(self, secret: Secret | None) -> Ring:
        if secret is None:
            raise StoreError(f"{self._what} does not exist. Make it: `python -m function_app prepare`.")
        try:
            return Ring.read(secret.text)
        except RingError as error:
            raise StoreError(f"{self._what} holds no signing keys: {error}. Restore an earlier version.") from error
