"""``SigningKeys`` of a key ring that is stored as one secret in a cloud vault.

The keys are a secret and not keys of the vault. Azure Key Vault supports no Ed25519 keys (P-256, P-256K, P-384, P-521,
RSA). AWS KMS has supported them since 2025, but signs at most 4,096 bytes; a command with a script has up to 64 KB.
Each command and token would also require a request. The vault encrypts the secret, controls access and logs reads.

The functions only read. ``python -m function_app prepare`` creates the secret and ``rotate-keys`` changes it, with the
permissions of the person who deploys. Two concurrent runs are detected only as far as the vault supports it.
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

CACHE_MS = 60_000
"""Lifetime of the cached ring: less than the time for devices to learn a key."""
MIN_REFRESH_MS = 5_000
"""Minimum time between two reads for unknown keys: any client can send an unknown key id."""
_log = logging.getLogger(__name__)


class Secret(NamedTuple):
    """The text and version of the vault's secret."""

    text: str
    version: str


class VaultKeys(RingKeys):
    """``SigningKeys`` in a vault; error messages name the secret as ``resource``."""

    def __init__(self, *, resource: str, now_ms: Callable[[], int] = wall_ms) -> None:
        super().__init__(now_ms=now_ms)
        self._resource = resource
        self._cache: Ring | None = None
        self._read_ms = 0
        self._lock = asyncio.Lock()

    async def prepare(self) -> None:
        """Create the secret with a first key if it does not exist. Idempotent.

        Raises:
            StoreError: It cannot be created.
        """
        if await self._fetch() is None:
            await self._create(Ring.first(signing.generate()).text)

    @abstractmethod
    async def _fetch(self) -> Secret | None:
        """Read the secret; ``None`` if it does not exist.

        Raises:
            StoreError: The vault cannot be used.
        """

    @abstractmethod
    async def _create(self, text: str) -> None:
        """Create the secret. If another process creates it at the same time, either one may remain."""

    @abstractmethod
    async def _put(self, text: str) -> None:
        """Write a new version of the secret."""

    def _cached(self) -> Ring:
        if self._cache is None:
            raise StoreError(f"{self._resource} has not been read yet")
        return self._cache

    async def _ring(self, *, refresh: bool = False) -> Ring:
        async with self._lock:
            age_ms = self._now_ms() - self._read_ms
            if self._cache is None or not 0 <= age_ms < (MIN_REFRESH_MS if refresh else CACHE_MS):
                await self._update()
            return self._cached()

    async def _update(self) -> None:
        """Read the secret. If the vault cannot be used, the cached ring remains in use."""
        self._read_ms = self._now_ms()
        try:
            self._cache = self._parse(await self._fetch())
        except StoreError as error:
            if self._cache is None:
                raise
            _log.warning("%s; the cached keys remain in use", error)

    async def _change(self, change: Callable[[Ring], Ring]) -> Ring:
        secret = await self._fetch()
        ring = change(self._parse(secret))
        if await self._fetch() != secret:
            raise StoreError(f"{self._resource} was changed by another process. Check it, and try again.")
        await self._put(ring.text)
        async with self._lock:
            self._cache, self._read_ms = ring, self._now_ms()
        return ring

    def _parse(self, secret: Secret | None) -> Ring:
        if secret is None:
            raise StoreError(f"{self._resource} does not exist. Create it: `python -m function_app prepare`.")
        try:
            return Ring.read(secret.text)
        except RingError as error:
            raise StoreError(
                f"{self._resource} contains no valid signing keys: {error}. Restore an earlier version."
            ) from error
