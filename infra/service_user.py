"""The user that runs a third-party server, and files that this user may read."""

import os
import pwd
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

_OVERFLOW_UID = 65_534
"""The kernel's user without rights."""
_UID_MAP = Path("/proc/self/uid_map")


class ServiceUser(NamedTuple):
    """The user that runs a server.

    Attributes:
        uid: User id.
        gid: Group id.
        notice: Deviation from the recommended user, with advice; may be empty.
    """

    uid: int
    gid: int
    notice: str = ""

    @property
    def ids(self) -> tuple[int, int] | None:
        """User id and group id, or ``None`` if they are those of this program."""
        return (self.uid, self.gid) if self.differs else None

    @property
    def differs(self) -> bool:
        """Whether the server runs as another user than this program."""
        return self.uid != os.geteuid()

    def own(self, paths: Iterable[Path]) -> None:
        """Give the existing ones of these paths to the user. Links are not followed.

        Raises:
            OSError: The owner cannot be changed.
        """
        for path in paths:
            if self.differs and path.exists():
                os.chown(path, self.uid, self.gid, follow_symlinks=False)


def choose(name: str) -> ServiceUser:
    """The user for a server: a user without rights if this program runs as root, otherwise the current user.

    Args:
        name: Of the server and of the user that its package creates.
    """
    current = ServiceUser(os.geteuid(), os.getegid())
    if current.uid != 0:
        return current
    try:
        entry = pwd.getpwnam(name)
        chosen = ServiceUser(entry.pw_uid, entry.pw_gid)
    except KeyError:
        notice = (
            f"no user '{name}' exists; {name} runs with the user id {_OVERFLOW_UID}, which other services "
            f"may use, too. Create one: adduser --system --group {name}"
        )
        chosen = ServiceUser(_OVERFLOW_UID, _OVERFLOW_UID, notice)
    if not _exists_here(chosen.uid):
        return current._replace(notice=f"this container has no other user, so {name} runs as the current one")
    return chosen


def _exists_here(uid: int) -> bool:
    """Whether the user namespace of this process, for example of a container, includes the user."""
    try:
        ranges = [[int(number) for number in line.split()] for line in _UID_MAP.read_text().splitlines()]
    except OSError:
        return True
    return any(first <= uid < first + count for first, _, count in ranges)
