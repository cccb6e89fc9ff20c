"""Releases side by side, as ``install-agent.sh`` installs them, and links to two of them.

PREFIX/
    installation           home of the agent, user and unit of the service
    bin/telescope-agent    launcher; does not change with the release
    releases/VERSION/      one virtual environment each; ``.complete`` is written last
    current, previous      links to releases
    trial                  the trial of the release in use, until it has ended
"""

import contextlib
import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from device_agent.cli.releases.trial import FAILED, RESULT_FILE
from device_agent.config.errors import ConfigError

SETTINGS_FILE, TRIAL_FILE, COMPLETE_FILE = "installation", "trial", ".complete"
KEEP_RELEASES = 3
_UMASK = 0o022
"""Releases are readable for the user of the service, also if root installs them."""


@dataclass(frozen=True, slots=True)
class PendingTrial:
    """A trial whose end has not been processed.

    Attributes:
        trial: Its id.
        version: The release on trial.
        needs_link: Whether its link must come up.
        timeout_s: Time for its proof [s].
        before: The value of ``previous`` before the switch; empty for none.
    """

    trial: str
    version: str
    needs_link: bool
    timeout_s: float
    before: str

    @classmethod
    def new(cls, version: str, *, needs_link: bool, timeout_s: float, before: str) -> "PendingTrial":
        """A trial with a new id."""
        return cls(f"{version}-{secrets.token_hex(4)}", version, needs_link, timeout_s, before)


class Installation:
    """Reads and changes an installation. Each change is one atomic rename."""

    def __init__(self, prefix: Path) -> None:
        self.prefix = prefix
        try:
            lines = (prefix / SETTINGS_FILE).read_text(encoding="utf-8").splitlines()
        except OSError as error:
            raise ConfigError(f"{prefix / SETTINGS_FILE} cannot be read: {error.strerror}") from error
        settings = dict(line.split("=", 1) for line in lines if "=" in line)
        self.home = Path(settings.get("home", ""))
        self.user = settings.get("user", "")

    @classmethod
    def of_this_program(cls) -> "Installation":
        """The installation that contains this program.

        Raises:
            ConfigError: It was installed in another way.
        """
        prefix = Path(sys.prefix).resolve().parent.parent
        if not (prefix / SETTINGS_FILE).is_file():
            raise ConfigError(
                "this agent was not installed by install-agent.sh, so it cannot update itself. Stop the agent, then "
                "use `pipx upgrade telescope-agent`, or the program that installed it"
            )
        return cls(prefix)

    # ------------------------------------------------------------ releases

    def release(self, version: str) -> Path:
        """Folder of a release."""
        return self.prefix / "releases" / version

    def linked(self, name: str) -> str:
        """The release that ``current`` or ``previous`` names; empty if there is none."""
        try:
            return (self.prefix / name).readlink().name
        except OSError:
            return ""

    def is_complete(self, version: str) -> bool:
        """Whether the installation of a release was finished."""
        return bool(version) and (self.release(version) / COMPLETE_FILE).is_file()

    def versions(self) -> list[str]:
        """The complete releases, the newest installation first."""
        folders = [path.parent for path in (self.prefix / "releases").glob(f"*/{COMPLETE_FILE}")]
        return [folder.name for folder in sorted(folders, key=lambda folder: -folder.stat().st_mtime)]

    def link(self, name: str, version: str) -> None:
        """Let ``current`` or ``previous`` name another release; without a version, remove the link."""
        if not version:
            (self.prefix / name).unlink(missing_ok=True)
            return
        temporary = self.prefix / f".{name}.{os.getpid()}"
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(Path("releases", version))
        temporary.replace(self.prefix / name)

    def prune(self, keep: int) -> list[str]:
        """Remove old releases, except the one in use and the one before; returns the removed ones."""
        needed = {self.linked("current"), self.linked("previous")}
        kept = len(needed - {""})
        removed = []
        for version in self.versions():
            if version in needed:
                continue
            kept += 1
            if kept > keep:
                (self.release(version) / COMPLETE_FILE).unlink()
                shutil.rmtree(self.release(version), ignore_errors=True)
                removed.append(version)
        return removed

    # ------------------------------------------------------------ trial

    def trial(self) -> PendingTrial | None:
        """The trial of the release in use; one that was prepared for a release that is not in use does not count."""
        try:
            words = (self.prefix / TRIAL_FILE).read_text(encoding="utf-8").split(" ")
            trial = PendingTrial(words[0], words[1], words[2] == "1", float(words[3]), words[4].strip())
        except (OSError, ValueError, IndexError):
            return None
        return trial if trial.version == self.linked("current") else None

    def write_trial(self, trial: PendingTrial) -> None:
        """Announce a trial to the launcher."""
        line = f"{trial.trial} {trial.version} {int(trial.needs_link)} {trial.timeout_s:g} {trial.before}\n"
        temporary = self.prefix / f".{TRIAL_FILE}.{os.getpid()}"
        temporary.write_text(line, encoding="utf-8")
        temporary.replace(self.prefix / TRIAL_FILE)

    def end_trial(self) -> None:
        """Remove the announcement."""
        (self.prefix / TRIAL_FILE).unlink(missing_ok=True)

    def result(self, trial: PendingTrial) -> tuple[str, str]:
        """Result of a trial and its reason; the result is a number of starts, or empty, while there is none."""
        try:
            line = (self.home / RESULT_FILE).read_text(encoding="utf-8", errors="replace")[:500]
        except OSError:
            return "", ""
        found, _, rest = line.strip().partition(" ")
        result, _, reason = rest.partition(" ")
        return (result, reason) if found == trial.trial else ("", "")

    def undo(self, trial: PendingTrial) -> str:
        """Use the release before a failed trial again; returns its version."""
        version = self.linked("previous")
        self.link("current", version)
        self.link("previous", trial.before)
        self.end_trial()
        return version

    def settle(self) -> str:
        """Process the end of a trial whose program was interrupted; returns what happened, or an empty string."""
        trial = self.trial()
        if trial is None:
            self.end_trial()
            return ""
        result, reason = self.result(trial)
        if result == FAILED:
            return f"release {trial.version} failed ({reason}); release {self.undo(trial)} is in use again"
        if result == "passed":
            self.end_trial()
        return ""

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the exclusive right to change the installation.

        Raises:
            ConfigError: Another program changes it, or this user may not.
        """
        import fcntl  # noqa: PLC0415 (does not exist on Windows, where install-agent.sh does not run)

        os.umask(_UMASK)
        try:
            descriptor = os.open(self.prefix / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise ConfigError(f"{self.prefix} cannot be changed by this user ({error.strerror}); use sudo") from error
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(f"another program changes {self.prefix} at the moment; wait for its end") from error
            yield
        finally:
            os.close(descriptor)
