"""Folders whose content only their own user may access, independent of the umask that created it."""

import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path

UMASK = 0o077
"""Mode bits that the programs of this project never set on new files."""
_log = logging.getLogger(__name__)


def exposed(folder: Path) -> Iterator[Path]:
    """Paths that other users may access: the content of ``folder``, then ``folder``. Links are not followed.

    Windows has no such mode bits: there the folder's access control applies.
    """
    if os.name == "nt" or not folder.is_dir():
        return
    for parent, folders, files in os.walk(folder, topdown=False):
        for path in (*(Path(parent, name) for name in sorted((*files, *folders))), *_last(folder, Path(parent))):
            try:
                mode = path.lstat().st_mode
            except FileNotFoundError:
                continue  # a running program removed it
            if not stat.S_ISLNK(mode) and mode & UMASK:
                yield path


def restrict(folder: Path, *, advice: str) -> int:
    """Remove the access of other users to ``folder`` and its content; returns the number of changed paths.

    The folder itself is changed last, so that an interrupted repair is repeated. A folder that is already private
    protects its content and is not searched. Folders of another user and folders for all users, such as ``/tmp``, stay
    unchanged. ``advice`` completes the warning "if another user may have read it, …".
    """
    try:
        status = folder.stat()
    except OSError:
        return 0
    if os.name == "nt" or not status.st_mode & UMASK:
        return 0
    if status.st_uid != os.geteuid() or status.st_mode & stat.S_ISVTX:
        _log.warning("%s is not a private folder of this user; use a folder of its own with mode 700", folder)
        return 0
    changed = 0
    for path in exposed(folder):
        try:
            path.chmod(stat.S_IMODE(path.lstat().st_mode) & ~UMASK)
        except OSError as error:
            _log.warning("%s stays accessible to other users of this machine: %s", path, error.strerror)
        else:
            changed += 1
    _log.warning(
        "removed the access of other users to %s (%d entries); if another user may have read it, %s",
        folder,
        changed,
        advice,
    )
    return changed


def _last(folder: Path, parent: Path) -> tuple[Path, ...]:
    return (folder,) if parent == folder else ()
