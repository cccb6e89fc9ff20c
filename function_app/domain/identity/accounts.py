"""People: accounts, who is asking, and what they may do to a device."""

import unicodedata
from dataclasses import dataclass
from enum import StrEnum

from function_app.domain.common.timestamps import NEVER_MS


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


def fold_name(name: str) -> str:
    """A name as names are compared: "Anna", "ANNA" and " anna" are one person, however a keyboard makes the letters."""
    plain = unicodedata.normalize("NFKC", name).casefold()
    return " ".join(unicodedata.normalize("NFKC", plain).split())


@dataclass(frozen=True, slots=True)
class Identity:
    """Who is asking: an account in one sign-in session. Two browsers of one person are two identities.

    Attributes:
        key: The id of the API key it came by; empty for a person. Such an identity's session is the key's.
        most: No role above this, whatever it owns or is shared with it.
        only: The devices (their ids) and spaces (``space:<id>``) it is kept to; empty: all of them.
        until_ms: The end of its session, or of its key [ms since 1970]: what it is given ends then at the latest.
    """

    account: str
    name: str
    session: str
    key: str = ""
    most: Role = Role.OWNER
    only: tuple[str, ...] = ()
    until_ms: int = NEVER_MS

    def lifetime_s(self, wanted_s: int, now_ms: int) -> int:
        """For how long something is given to it that could be good for so long [s]; one second at least."""
        return max(1, min(wanted_s, (self.until_ms - now_ms) // 1000))


@dataclass(frozen=True, slots=True)
class Space:
    """A room: a place for agents and devices. Belongs to one account, whose first has ``created_ms`` 0."""

    id: str
    name: str
    created_ms: int = 0
