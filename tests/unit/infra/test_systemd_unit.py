"""The agent's systemd unit is valid, hardened, and compatible with the script sandbox."""

import re
import subprocess
from pathlib import Path

from tests.harness.paths import ROOT

UNIT = ROOT / "infra/systemd/telescope-agent.service"
SANDBOX = {
    *("clone", "clone3", "unshare", "mount", "umount2", "pivot_root", "prctl", "seccomp", "setrlimit", "prlimit64"),
    *("landlock_create_ruleset", "landlock_add_rule", "landlock_restrict_self", "pidfd_open", "pidfd_send_signal"),
    *("socketpair", "sendmsg", "recvmsg"),
}
"""System calls that the sandbox and bubblewrap need."""
MAX_EXPOSURE = 30
"""Exposure score of systemd, 0…100; 96 without hardening."""


def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace("/opt/telescope", str(ROOT)))
    result = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, ""), result


def test_the_exposure_is_low(tmp_path: Path) -> None:
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text())
    command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={MAX_EXPOSURE}", str(unit)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-300:]


def test_the_sandbox_is_not_restricted() -> None:
    text = UNIT.read_text()
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
