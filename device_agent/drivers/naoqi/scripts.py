"""Python programs for NAOqi in a local folder, which run only with the permission of the robot's owner."""

import logging
import os
import stat
from collections.abc import Callable, Sequence
from pathlib import Path

from device_agent.ports.skills import SkillError

_WRITABLE = stat.S_IWGRP | stat.S_IWOTH
_log = logging.getLogger(__name__)


class LegacyScripts:
    """The scripts of one device.

    Args:
        folder: Their folder, or ``None`` without the owner's permission.
        python: Interpreter that runs them.
    """

    def __init__(self, folder: Path | None, python: str) -> None:
        self._folder = folder
        self.python = python

    def names(self) -> Sequence[str]:
        """Names of the scripts that may run, sorted. Reads the folder."""
        names = []
        for path in sorted(self._folder.glob("*.py")) if self._folder is not None else ():
            try:
                self.find(path.name)
            except SkillError as error:
                _log.warning("%s", error)
            else:
                names.append(path.name)
        return names

    def find(self, name: str) -> Path:
        """The file of a script.

        Raises:
            SkillError: The owner has not permitted scripts, the script is missing, or another user may change it.
        """
        if self._folder is None:
            raise SkillError(
                "scripts of this robot need its owner's permission: set legacy_scripts = true in agent.toml, "
                "in the options of the device"
            )
        folder = self._folder.absolute()
        path = folder / name
        if path.parent != folder or path.suffix != ".py":
            raise SkillError(f"no script '{name[:80]}' in {folder}")
        self._check(path, stat.S_ISREG, "a file")
        self._check(folder, stat.S_ISDIR, "a folder")
        for parent in folder.resolve().parents:
            status = parent.stat()
            changeable = status.st_mode & _WRITABLE and not status.st_mode & stat.S_ISVTX
            if changeable or status.st_uid not in {0, os.geteuid()}:
                raise SkillError(f"{parent} can be changed by another user; move the scripts to a private folder")
        return path

    def _check(self, path: Path, is_kind: Callable[[int], bool], kind: str) -> None:
        try:
            status = path.lstat()
        except OSError as error:
            raise SkillError(f"{path} cannot be read: {error.strerror}") from error
        if not is_kind(status.st_mode):
            raise SkillError(f"{path} is not {kind}; links are not followed")
        if status.st_uid != os.geteuid() or status.st_mode & _WRITABLE:
            raise SkillError(f"{path} can be changed by another user; own it as the agent's user with mode 700")
