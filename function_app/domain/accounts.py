"""People: accounts, who is asking, and what they may do to a device."""

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What an account may do with a device."""

    OWNER = "owner"
    OPERATOR = "operator"
    VIEWER = "viewer"

    @property
    def may_operate(self) -> bool:
        """Take control and ask for it, start actions, stop, reset. A viewer watches: a shared link stops no room."""
        return self is not Role.VIEWER

    @property
    def may_own(self) -> bool:
        """Un-pair, share, take control over from somebody."""
        return self is Role.OWNER


@dataclass(frozen=True, slots=True)
class Account:
    """A login, and the tenant that owns spaces, agents and movements."""

    id: str
    name: str


@dataclass(frozen=True, slots=True)
class Identity:
    """Who is asking: an account in one sign-in session. Two browsers of one person are two identities.

    Attributes:
        key: The id of the API key it came by; empty for a person. Such an identity's session is the key's.
        most: No role above this, whatever it owns or is shared with it.
        only: The devices (their ids) and spaces (``space:<id>``) it is kept to; empty: all of them.
    """

    account: str
    name: str
    session: str
    key: str = ""
    most: Role = Role.OWNER
    only: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Space:
    """A room: a place for agents and devices. Belongs to one account, whose first has ``created_ms`` 0."""

    id: str
    name: str
    created_ms: int = 0
