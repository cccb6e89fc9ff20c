"""Passwords as they are stored: by a function that is slow on purpose, so that a stolen table tells none soon."""

from typing import Protocol


class PasswordHasher(Protocol):
    """Makes and checks them. Each call takes tens of milliseconds of a processor; none of them blocks the others."""

    async def make(self, password: str) -> str:
        """A salted hash that names its own parameters."""

    async def check(self, stored: str | None, password: str) -> bool:
        """Whether it is this password.

        Args:
            stored: What ``make`` gave; ``None`` where there is none: it takes as long, and is never right.
            password: What somebody says.
        """

    def outdated(self, stored: str) -> bool:
        """Whether ``make`` would use other parameters today."""
