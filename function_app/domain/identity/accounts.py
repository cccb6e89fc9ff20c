"""Accounts, roles and the identity of a caller."""

import unicodedata
from dataclasses import dataclass
from enum import StrEnum

from function_app.domain.common.timestamps import NEVER_MS


class Role(StrEnum):
    """The role of an account on a device."""

    OWNER = "owner"
    OPERATOR = "operator"
    VIEWER = "viewer"

    @property
    def may_operate(self) -> bool:
        """Whether the role may control the device, start actions, stop and reset. Viewers cannot stop devices."""
        return self is not Role.VIEWER

    @property
    def may_own(self) -> bool:
        """Whether the role may unpair, share and take over control."""
        return self is Role.OWNER


@dataclass(frozen=True, slots=True)
class Account:
    """A login, and the tenant that owns spaces, agents and movements."""

    id: str
    name: str


def fold_name(name: str) -> str:
    """The name in the form that is compared: "Anna", "ANNA" and " anna" are equal."""
    plain = unicodedata.normalize("NFKC", name).casefold()
    return " ".join(unicodedata.normalize("NFKC", plain).split())


@dataclass(frozen=True, slots=True)
class Identity:
    """An account in one sign-in session. Two browsers of one person are two identities.

    Attributes:
        key: Id of the API key; empty for a person. An API key has its own session.
        most: Highest role, regardless of ownership and shares.
        only: Allowed devices (ids) and spaces (``space:<id>``); empty: all.
        until_ms: End of the session or key [ms since 1970]; all grants end by then.
    """

    account: str
    name: str
    session: str
    key: str = ""
    most: Role = Role.OWNER
    only: tuple[str, ...] = ()
    until_ms: int = NEVER_MS

    def lifetime_s(self, requested_s: int, now_ms: int) -> int:
        """The lifetime of a grant [s]: ``requested_s``, limited by the end of the session; at least 1 s."""
        return max(1, min(requested_s, (self.until_ms - now_ms) // 1000))


@dataclass(frozen=True, slots=True)
class Space:
    """A room for agents and devices, owned by one account. The account's first space has ``created_ms`` 0."""

    id: str
    name: str
    created_ms: int = 0
