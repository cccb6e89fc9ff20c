"""Hashes passwords with a slow function, so that a stolen table does not reveal them."""

from typing import Protocol


class PasswordHasher(Protocol):
    """Creates and verifies password hashes. Each call takes tens of milliseconds of CPU and does not block others.

    Example::

        stored = await hasher.make(password)
        assert await hasher.check(stored, password)
    """

    async def make(self, password: str) -> str:
        """A salted hash that contains its parameters."""

    async def check(self, stored: str | None, password: str) -> bool:
        """Whether the password matches.

        ``stored`` is a result of ``make``; ``None`` takes equally long and never matches.
        """

    def outdated(self, stored: str) -> bool:
        """Whether ``make`` would use other parameters now."""
