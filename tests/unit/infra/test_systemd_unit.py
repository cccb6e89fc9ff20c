"""The agent's systemd unit: what systemd itself says of it, and that what the jail of scripts needs is left."""

import re
import subprocess
from pathlib import Path

from tests.harness.paths import ROOT

UNIT = ROOT / "infra/systemd/telescope-agent.service"
JAIL = {"clone", "clone3", "unshare", "mount", "umount2", "pivot_root", "prctl", "seccomp", "landlock_create_ruleset",
        "landlock_add_rule", "landlock_restrict_self", "setrlimit", "prlimit64", "pidfd_open", "pidfd_send_signal",
        "socketpair", "sendmsg", "recvmsg"}  # fmt: skip
"""System calls by which scripts are locked in, in the agent's own process tree and in bubblewrap's."""
MOST_EXPOSED = 30
"""Of 100, by systemd's own measure; 96 is a service without any of this."""


def test_systemd_takes_it(tmp_path: Path) -> None:
    here = tmp_path / UNIT.name
    here.write_text(UNIT.read_text().replace("/opt/telescope", str(ROOT)))
    done = subprocess.run(["systemd-analyze", "verify", here], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done


def test_little_of_the_machine_is_exposed(tmp_path: Path) -> None:
    here = tmp_path / UNIT.name
    here.write_text(UNIT.read_text())
    command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={MOST_EXPOSED}", str(here)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:]


def test_the_jail_still_works_behind_it() -> None:
    text = UNIT.read_text()
    denied = re.search(r"^SystemCallFilter=~(.*)$", text, re.MULTILINE)
    assert denied is not None
    for group in denied[1].split():
        listed = subprocess.run(
            ["systemd-analyze", "syscall-filter", group], capture_output=True, text=True, check=True
        )
        assert not JAIL & set(listed.stdout.split()), group
    for switch in ("RestrictNamespaces", "MemoryDenyWriteExecute", "PrivateUsers", "SystemCallFilter=@"):
        assert not re.search(rf"^{switch}", text, re.MULTILINE), f"{switch} would end bubblewrap or the renderer"
    families = re.search(r"^RestrictAddressFamilies=(.*)$", text, re.MULTILINE)
    assert families is not None
    assert {"AF_UNIX", "AF_NETLINK"} <= set(families[1].split()), "bubblewrap sets up a network of its own"
