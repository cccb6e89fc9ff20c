"""``update``, ``rollback``, ``release`` and ``service-unit``."""

import argparse
import importlib.resources
import subprocess
import sys
from pathlib import Path

import msgspec

from device_agent.cli.arguments import Commands
from device_agent.cli.local_control import client
from device_agent.cli.local_control.messages import ControlRequest
from device_agent.cli.releases.checks import LOW_PRIORITY, ReleaseReport, check_release
from device_agent.cli.releases.installation import KEEP_RELEASES, Installation
from device_agent.cli.releases.switch import Switch
from device_agent.config import release
from device_agent.config.errors import ConfigError

WAIT_S, TRIAL_S = 3600.0, 120.0
_ASSETS = importlib.resources.files("device_agent.cli.releases")
_PREPARED = "prepared "


def add_commands(commands: Commands, _home: Path) -> None:
    """Add the commands of installed releases."""
    update = commands.add_parser(
        "update",
        help="install another release beside this one and switch to it while no device moves",
        description="Installs a release, checks it, and waits until no device moves and no operator has control. Then "
        "the agent restarts with it. If it does not work, the former release is used again.",
    )
    update.add_argument("--version", help="version from PyPI (default: the newest)")
    update.add_argument("--bundle", type=Path, help="offline bundle: an archive of `make agent-bundle`, or its folder")
    update.add_argument("--keep", type=_count, default=KEEP_RELEASES, help="number of releases to keep (default: 3)")
    _add_times(update)
    update.set_defaults(command=_update)
    rollback = commands.add_parser(
        "rollback",
        help="switch back to the release before while no device moves",
        description="Switches to an installed release as `update` does. It is refused if that release cannot read the "
        "journal or another file in its present format.",
    )
    rollback.add_argument("--version", help="an installed release (default: the one before)")
    _add_times(rollback)
    rollback.set_defaults(command=_rollback)
    show = commands.add_parser("release", help="show this release, the other installed ones and whether the agent runs")
    show.add_argument("--json", action="store_true", help="print version and state formats of this release as JSON")
    show.set_defaults(command=_release)
    unit = commands.add_parser("service-unit", help="print the systemd unit of an installation")
    unit.add_argument("--prefix", type=Path, required=True, help="folder of the installation")
    unit.set_defaults(command=_service_unit)


def _add_times(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--wait", type=_seconds, default=WAIT_S, metavar="SECONDS", help="wait for rest (default: %(default)g)"
    )
    parser.add_argument(
        "--trial", type=_seconds, default=TRIAL_S, metavar="SECONDS",
        help="time in which the release must start its devices and connect (default: %(default)g)",
    )  # fmt: skip


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 7 * 24 * 3600:
        raise argparse.ArgumentTypeError("must be between 0 s and a week")
    return value


def _count(text: str) -> int:
    value = int(text)
    if not 2 <= value <= 100:  # noqa: PLR2004 (the release in use and the one before)
        raise argparse.ArgumentTypeError("must be between 2 and 100")
    return value


def _update(options: argparse.Namespace) -> int:
    installation = Installation.of_this_program()
    with installation.lock():
        _settle(installation)
        version = _prepare(installation, options)
        if version == installation.linked("current"):
            print(f"release {version} is already in use")
            return 0
        return _switch(installation, version, options, keep=options.keep)


def _rollback(options: argparse.Namespace) -> int:
    installation = Installation.of_this_program()
    with installation.lock():
        _settle(installation)
        version = options.version or installation.linked("previous")
        if not version:
            raise ConfigError("there is no release before this one; name one with --version")
        if not installation.is_complete(version):
            raise ConfigError(
                f"release {version} is not installed; installed are {', '.join(sorted(installation.versions()))}"
            )
        if version == installation.linked("current"):
            print(f"release {version} is already in use")
            return 0
        return _switch(installation, version, options, keep=0)


def _settle(installation: Installation) -> None:
    if settled := installation.settle():
        print(settled, flush=True)
    trial = installation.trial()
    if trial is not None:
        raise ConfigError(
            f"release {trial.version} is still being checked; start the agent's service, and try again in a minute"
        )


def _switch(installation: Installation, version: str, options: argparse.Namespace, *, keep: int) -> int:
    check_release(installation, version)
    print(f"release {version} is ready", flush=True)
    print(Switch(installation, wait_s=options.wait, trial_s=options.trial).to(version), flush=True)
    if keep:
        for removed in installation.prune(keep):
            print(f"removed release {removed}")
    return 0


def _prepare(installation: Installation, options: argparse.Namespace) -> str:
    """Install a release beside the one in use; returns its version."""
    command = [*LOW_PRIORITY, "sh", str(_ASSETS / "install-agent.sh"), "--prepare"]
    command += ["--prefix", str(installation.prefix), "--python", str(Path(sys.executable).resolve())]
    if options.bundle is not None:
        command += ["--bundle", str(options.bundle)]
    if options.version is not None:
        command += ["--version", options.version]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)  # noqa: S603 (part of this package)
    last = done.stdout.strip().rpartition("\n")[2]
    if done.returncode or not last.startswith(_PREPARED):
        raise ConfigError("the release was not installed; the reason is above. The release in use is unchanged")
    return last.removeprefix(_PREPARED)


def _release(options: argparse.Namespace) -> int:
    if options.json:
        report = ReleaseReport(release.VERSION, dict(release.READ), dict(release.WRITTEN))
        print(msgspec.json.encode(report).decode())
        return 0
    installation = Installation.of_this_program()
    trial = installation.trial()
    print(f"in use     {installation.linked('current')}")
    print(f"before     {installation.linked('previous') or '–'}")
    print(f"installed  {' '.join(sorted(installation.versions()))}")
    if trial is not None:
        result, reason = installation.result(trial)
        print(f"on trial   {trial.version}: {result or 'not started'} {reason}".rstrip())
    answer = client.call(installation.home, ControlRequest(kind="status"))
    print(f"running    {'no' if answer is None else answer.version}")
    return 0


def _service_unit(options: argparse.Namespace) -> int:
    installation = Installation(options.prefix)
    name = "telescope-agent.service" if installation.user else "telescope-agent.user.service"
    text = (_ASSETS / name).read_text(encoding="utf-8")
    for key, value in (("PREFIX", installation.prefix), ("HOME", installation.home), ("USER", installation.user)):
        text = text.replace(f"@{key}@", str(value))
    print(text, end="")
    return 0
