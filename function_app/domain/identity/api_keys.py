"""API keys: credentials for programs, with limited permissions."""

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
    """An API key. Only the hash of its secret is stored.

    A fast hash is sufficient because the secret has 256 random bits.

    Attributes:
        owner: Name of the account.
        label: Purpose, as entered by the owner.
        most: Highest role; never ``owner``.
        only: Allowed devices (ids) and spaces (``space:<id>``); empty: all of the account.
        expires_ms: Expiry time [ms since 1970].
        used_ms: Last use, with a resolution of one hour; 0: never.
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
        """The identity of a caller with this key. Its name contains the label of the key."""
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
        """Whether this is the secret of the key. Takes constant time."""
        return hmac.compare_digest(self.hash, hashed(secret))


def new_key_id() -> str:
    """The id of a new key."""
    return new_id(16)


def key_of(session: str) -> str:
    """The id of the key that owns a session; empty for a person's session."""
    return session.removeprefix(_SESSION) if session.startswith(_SESSION) else ""


def token(key: str, secret: str) -> str:
    """The token of a key. Its prefix allows scanners for leaked secrets to find it."""
    return f"{PREFIX}{key}_{secret}"


def split(text: str) -> tuple[str, str] | None:
    """Id and secret of a token, or ``None`` for an invalid token."""
    result = _TOKEN.match(text)
    return (result[1], result[2]) if result else None


def hashed(secret: str) -> str:
    """The stored form of a secret."""
    return hashlib.sha256(secret.encode()).hexdigest()
