"""Passwords by argon2id.

Its parameters are those of the OWASP Password Storage Cheat Sheet: 19 MiB, two passes, one lane. Each hash names its
own. A sign-in after an increase of these creates a new hash.
"""

import asyncio
import secrets
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from argon2 import PasswordHasher

MEMORY_KIB: Final = 19 * 1024
PASSES: Final = 2
LANES: Final = 1
AT_ONCE: Final = 4
"""At most so many are computed in the same moment: guesses by the hundred take neither all memory nor all threads."""


class Argon2Hashes:
    """``PasswordHasher`` by argon2-cffi, whose work is done in threads, without Python's lock."""

    def __init__(self) -> None:
        self._made: PasswordHasher | None = None
        self._dummy_hash = ""
        self._gate = asyncio.Semaphore(AT_ONCE)

    async def make(self, password: str) -> str:
        async with self._gate:
            return await asyncio.to_thread(self._hasher().hash, password)

    async def check(self, stored: str | None, password: str) -> bool:
        from argon2.exceptions import InvalidHashError, VerificationError  # noqa: PLC0415 (only where it is in use)

        if not self._dummy_hash:
            self._dummy_hash = await self.make(secrets.token_urlsafe(32))
        async with self._gate:
            try:
                right = await asyncio.to_thread(self._hasher().verify, stored or self._dummy_hash, password)
            except (VerificationError, InvalidHashError):
                return False
        return right and bool(stored)

    def outdated(self, stored: str) -> bool:
        return self._hasher().check_needs_rehash(stored)

    def _hasher(self) -> "PasswordHasher":
        if self._made is None:
            from argon2 import PasswordHasher  # noqa: PLC0415 (only where it is in use)

            self._made = PasswordHasher(time_cost=PASSES, memory_cost=MEMORY_KIB, parallelism=LANES)
        return self._made
