"""Starts an attack host as root or as an unprivileged user."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec

from device_agent.sandbox.constants import LAYERS
from tests.harness.paths import ROOT
from tests.security.sandbox.attack_host import Result
from tests.security.sandbox.attacks import ATTACKS, PRELUDE

REPOSITORY = ROOT
UNPRIVILEGED = 65534


class AttackRunner:
    """An attack host and its pipe."""

    def __init__(self, *, root: bool, layers: Sequence[str] = LAYERS) -> None:
        self._results: dict[str, Result] = {}
        command = [] if root == (os.geteuid() == 0) else as_unprivileged_user()
        self._process = subprocess.Popen(
            [*command, sys.executable, "-m", "tests.security.sandbox.attack_host", ",".join(layers)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=REPOSITORY,
            env={"PATH": os.environ["PATH"], "OPENBLAS_NUM_THREADS": "1"},
        )

    def attack(self, name: str, *, untrusted: bool = False) -> Result:
        """Run one of the attacks."""
        result = self.run(name, ATTACKS[name], untrusted=untrusted)
        if not untrusted:
            self._results[name] = result
        return result

    def attacked(self, name: str) -> Result:
        """Return the cached result of an attack, or run it."""
        if name not in self._results:
            self._results[name] = self.attack(name)
        return self._results[name]

    def run(self, name: str, source: str, *, untrusted: bool = False) -> Result:
        """Run any script."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([name, source, untrusted]).encode() + b"\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, "the agent's side has ended: the attack reached it"
        return msgspec.json.decode(line, type=Result)

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=30)
        self._process.stdout.close()


def inside(source: str) -> str:
    """A script with the functions of the attacks."""
    return PRELUDE + source


def as_unprivileged_user() -> list[str]:
    """The prefix that runs a command as an unprivileged user, if root started the tests.

    That user cannot access root's folder. If Python or this repository is inside, the command runs in a mount namespace
    in which only these are visible.
    """
    needed = [Path(sys.prefix).resolve(), Path(sys.base_prefix), Path(sys.prefix), REPOSITORY]
    closed = {folder for path in needed for folder in path.parents if not folder.stat().st_mode & 0o001}
    user = ["setpriv", f"--reuid={UNPRIVILEGED}", f"--regid={UNPRIVILEGED}", "--clear-groups", "--inh-caps=-all"]
    if not closed:
        return user
    view = ["bwrap", "--dev-bind", "/", "/"]
    view += [part for folder in sorted(closed) for part in ("--perms", "0755", "--tmpfs", str(folder))]
    for path in dict.fromkeys(needed):
        if any(folder in path.parents for folder in closed):
            for folder in reversed(path.parents):
                view += ["--perms", "0755", "--dir", str(folder)] if closed & set(folder.parents) else []
            view += ["--ro-bind", str(path), str(path)]
    return [*view, "--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID", "--", *user]
