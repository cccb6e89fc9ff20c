"""API keys: what a program of somebody else's shows instead of signing in, and how little it may then do."""

import hashlib
import hmac
import re
from dataclasses import dataclass
from typing import Final

from function_app.domain.common.ids import new_id
from function_app.domain.identity.accounts import Identity, Role

MOST_DAYS: Final = 366
MOST_ONLY: Final = 100
PREFIX: Final = "ts_"
_TOKEN: Final = re.compile(r"\Ats_([a-z2-7]{16})_([A-Za-z0-9_-]{43})\Z")
_SESSION: Final = "key-"


@dataclass(frozen=True, slots=True)
class ApiKey:
    """A key, of which only the hash of the secret is kept.

    That needs no slow function as a password does: nobody guesses 256 random bits, however quick each guess.

    Attributes:
        owner: Name of the account.
        label: What it is for, in its maker's words.
        most: No role above this; never ``owner``.
        only: The devices (their ids) and spaces (``space:<id>``) that it is kept to; empty: all of the account's.
        expires_ms: From then on it is refused.
        used_ms: When it was last used, to the hour; 0: never.
    """

    id: str
    account: str
    owner: str
    label: str
    hash: str
    most: Role
    only: tuple[str, ...]
    created_ms: int
    expires_ms: int
    used_ms: int = 0

    @property
    def identity(self) -> Identity:
        """Who asks by it. People read beside the account which program it was."""
        return Identity(
            account=self.account,
            name=f"{self.owner} ({self.label})",
            session=f"{_SESSION}{self.id}",
            key=self.id,
            most=self.most,
            only=self.only,
            until_ms=self.expires_ms,
        )

    def matches(self, secret: str) -> bool:
        """Whether it is this key's secret. Takes as long for any."""
        return hmac.compare_digest(self.hash, hashed(secret))


def new_key_id() -> str:
    """The id of a new key."""
    return new_id(16)


def key_of(session: str) -> str:
    """The id of the key whose session this is; empty for a person's."""
    return session.removeprefix(_SESSION) if session.startswith(_SESSION) else ""


def token(key: str, secret: str) -> str:
    """What a program shows: its beginning is what scanners for leaked secrets look for."""
    return f"{PREFIX}{key}_{secret}"


def split(text: str) -> tuple[str, str] | None:
    """Id and secret in a token, or ``None`` where it cannot be one."""
    result = _TOKEN.match(text)
    return (result[1], result[2]) if result else None


def hashed(secret: str) -> str:
    """What is stored of a secret."""
    return hashlib.sha256(secret.encode()).hexdigest()
