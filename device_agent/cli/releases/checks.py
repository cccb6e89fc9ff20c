"""Checks of a release before it is used: it starts, reads the state on disk, and finds no problem that is new."""

import os
import subprocess
from pathlib import Path
from typing import Any

import msgspec

from device_agent.cli.releases.installation import Installation
from device_agent.config import release
from device_agent.config.errors import ConfigError

LOW_PRIORITY = ("nice", "-n", "5")
"""Prefix of commands that run beside control loops."""
_TIMEOUT_S = 300.0


class ReleaseReport(msgspec.Struct, frozen=True):
    """What ``telescope-agent release --json`` states about itself."""

    version: str
    reads: dict[str, int]
    writes: dict[str, int]


class _Finding(msgspec.Struct, frozen=True):
    check: str
    level: str
    message: str


class _Report(msgspec.Struct, frozen=True):
    findings: list[_Finding]


def check_release(installation: Installation, version: str) -> None:
    """Check that an installed release can replace the one in use, and that the replaced one can return.

    Raises:
        ConfigError: It cannot; the message states why.
    """
    report = _report(installation, version)
    present = release.present_formats(installation.home)
    if unreadable := release.too_new(present, report.reads):
        raise ConfigError(
            f"release {version} cannot read the present state of the agent: {', '.join(unreadable)}. A newer release "
            "wrote it; keep that release, or update to a newer one"
        )
    current = installation.linked("current")
    if installation.is_complete(current):
        _check_way_back(installation, current, report)
    new = _problems(installation, version)
    if new and installation.is_complete(current):
        known = _problems(installation, current)
        new = {check: message for check, message in new.items() if check not in known}
    if new:
        text = "; ".join(f"{check}: {message}" for check, message in new.items())
        raise ConfigError(f"release {version} has problems that release {current} does not have: {text}")


def _check_way_back(installation: Installation, current: str, report: ReleaseReport) -> None:
    unreadable = release.too_new(report.writes, _report(installation, current).reads)
    if unreadable:
        raise ConfigError(
            f"release {report.version} writes state that release {current} cannot read ({', '.join(unreadable)}), so "
            "a rollback would be impossible. First update to a release between them"
        )


def _report(installation: Installation, version: str) -> ReleaseReport:
    done = _run(installation, version, "release", "--json")
    try:
        report = msgspec.json.decode(done.stdout, type=ReleaseReport)
    except msgspec.DecodeError as error:
        last = (done.stderr.strip() or done.stdout.strip()).rpartition("\n")[2][:300]
        raise ConfigError(f"release {version} does not start: {last or f'exit code {done.returncode}'}") from error
    if report.version != version:
        raise ConfigError(f"the folder of release {version} contains version {report.version}; remove it and try again")
    return report


def _problems(installation: Installation, version: str) -> dict[str, str]:
    done = _run(installation, version, "doctor", "--json", "--home", str(installation.home))
    try:
        findings = msgspec.json.decode(done.stdout, type=_Report).findings
    except msgspec.DecodeError as error:
        last = done.stderr.strip().rpartition("\n")[2][:300]
        raise ConfigError(f"the self-test of release {version} failed: {last}") from error
    return {finding.check: finding.message for finding in findings if finding.level == "problem"}


def _run(installation: Installation, version: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    program = installation.release(version) / "bin" / "telescope-agent"
    try:
        return subprocess.run(  # noqa: S603 (a release of this installation)
            [*LOW_PRIORITY, str(program), *arguments],
            cwd=installation.prefix,
            capture_output=True,
            text=True,
            check=False,
            timeout=_TIMEOUT_S,
            umask=0o077,
            **as_owner(installation.home),
        )
    except subprocess.TimeoutExpired as error:
        raise ConfigError(f"release {version} does not respond within {_TIMEOUT_S:g} s") from error


def as_owner(home: Path) -> dict[str, Any]:
    """Options of ``subprocess`` that run a program as the owner of the agent's folder; none without root rights."""
    if os.geteuid() != 0 or not home.is_dir():
        return {}
    status = home.stat()
    return {"user": status.st_uid, "group": status.st_gid, "extra_groups": []}
