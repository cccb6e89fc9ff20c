"""Password hashing with argon2id.

The parameters are those of the OWASP Password Storage Cheat Sheet: 19 MiB, two passes, one lane. Each hash contains its
parameters. After a change of the parameters, the next sign-in creates a new hash.
"""

import asyncio
import secrets
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from argon2 import PasswordHasher

MEMORY_KIB: Final = 19 * 1024
PASSES: Final = 2
LANES: Final = 1
MAX_CONCURRENT: Final = 4
"""Limits memory and threads during many concurrent sign-in attempts."""


class Argon2Hashes:
    """``PasswordHasher`` with argon2-cffi, in threads; argon2-cffi releases the GIL."""

    def __init__(self) -> None:
        self._library: PasswordHasher | None = None
        self._dummy_hash = ""
        self._gate = asyncio.Semaphore(MAX_CONCURRENT)

    async def make(self, password: str) -> str:
        async with self._gate:
            return await asyncio.to_thread(self._hasher().hash, password)

    async def check(self, stored: str | None, password: str) -> bool:
        from argon2.exceptions import InvalidHashError, VerificationError  # noqa: PLC0415 (only where it is in use)

        if not self._dummy_hash:
            self._dummy_hash = await self.make(secrets.token_urlsafe(32))
        async with self._gate:
            try:
                matches = await asyncio.to_thread(self._hasher().verify, stored or self._dummy_hash, password)
            except (VerificationError, InvalidHashError):
                return False
        return matches and bool(stored)

    def outdated(self, stored: str) -> bool:
        return self._hasher().check_needs_rehash(stored)

    def _hasher(self) -> "PasswordHasher":
        if self._library is None:
            from argon2 import PasswordHasher  # noqa: PLC0415 (only where it is in use)

            self._library = PasswordHasher(time_cost=PASSES, memory_cost=MEMORY_KIB, parallelism=LANES)
        return self._library
