"""The agent's systemd units are valid, hardened, compatible with the script sandbox, and fit the launcher."""

import configparser
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from device_agent.__main__ import main
from device_agent.cli.releases.commands import TRIAL_S
from tests.harness.agent.stub_installation import StubInstallation
from tests.harness.paths import ROOT

MakeUnit = Callable[[str], Path]

RELEASES = ROOT / "device_agent/cli/releases"
SANDBOX = {
    *("clone", "clone3", "unshare", "mount", "umount2", "pivot_root", "prctl", "seccomp", "setrlimit", "prlimit64"),
    *("landlock_create_ruleset", "landlock_add_rule", "landlock_restrict_self", "pidfd_open", "pidfd_send_signal"),
    *("socketpair", "sendmsg", "recvmsg"),
}
"""System calls that the sandbox and bubblewrap need."""
MAX_EXPOSURE = 30
"""Exposure score of systemd, 0…100; 96 without hardening."""


@pytest.fixture
def make_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> MakeUnit:
    """Writes the unit that ``service-unit`` prints for an installation, with or without a user of the service."""

    def make(user: str) -> Path:
        stub = StubInstallation(tmp_path, "1", user=user)
        assert main(["service-unit", "--prefix", str(stub.prefix)]) == 0
        unit = tmp_path / "telescope-agent.service"
        unit.write_text(capsys.readouterr().out)
        return unit

    return make


@pytest.mark.parametrize(("user", "options"), [("root", []), ("", ["--user"])])
def test_systemd_accepts_the_unit(make_unit: MakeUnit, user: str, options: list[str]) -> None:
    unit = make_unit(user)
    command = ["systemd-analyze", *options, "verify", str(unit)]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(unit.parent)}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, ""), result


@pytest.mark.parametrize("user", ["robot", ""])
def test_an_agent_that_ends_for_an_update_is_started_again_by_the_launcher(make_unit: MakeUnit, user: str) -> None:
    unit = make_unit(user)
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(unit)
    service = parser["Service"]
    assert service["ExecStart"] == f"{unit.parent}/prefix/bin/telescope-agent run"
    assert service["Environment"] == f"TELESCOPE_AGENT_HOME={unit.parent}/home"
    assert (service["Restart"], service["Type"]) == ("always", "notify")
    assert parser["Unit"]["StartLimitIntervalSec"] == "0", "three failed starts must not end the restarts"
    assert float(service["TimeoutStartSec"]) > TRIAL_S, "the agent itself reports a failed check"
    assert not re.search(r"@[A-Z]+@", unit.read_text())
    if user:
        assert (service["User"], service["ReadWritePaths"]) == (user, f"{unit.parent}/home")


def test_the_exposure_is_low(make_unit: MakeUnit) -> None:
    unit = make_unit("robot")
    command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={MAX_EXPOSURE}", str(unit)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-300:]


def test_the_sandbox_is_not_restricted() -> None:
    text = (RELEASES / "telescope-agent.service").read_text()
    denied = re.search(r"^SystemCallFilter=~(.*)$", text, re.MULTILINE)
    assert denied is not None
    for group in denied[1].split():
        listed = subprocess.run(
            ["systemd-analyze", "syscall-filter", group], capture_output=True, text=True, check=True
        )
        assert not SANDBOX & set(listed.stdout.split()), group
    for switch in ("RestrictNamespaces", "MemoryDenyWriteExecute", "PrivateUsers", "SystemCallFilter=@"):
        assert not re.search(rf"^{switch}", text, re.MULTILINE), f"{switch} would break bubblewrap or the renderer"
    families = re.search(r"^RestrictAddressFamilies=(.*)$", text, re.MULTILINE)
    assert families is not None
    assert {"AF_UNIX", "AF_NETLINK"} <= set(families[1].split()), "bubblewrap creates a network namespace"
