"""Starts an attack host as root or as an unprivileged user."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import msgspec

from device_agent.sandbox.constants import LAYERS
from tests.harness.paths import ROOT
from tests.security.sandbox.attack_host import Result
from tests.security.sandbox.attacks import ATTACKS

UNPRIVILEGED = 65534


class AttackRunner:
    """An attack host, connected by pipes; ``with`` ends it."""

    def __init__(self, *, root: bool, layers: Sequence[str] = LAYERS) -> None:
        command = [] if root == (os.geteuid() == 0) else as_unprivileged_user()
        self._process = subprocess.Popen(
            [*command, sys.executable, "-m", "tests.security.sandbox.attack_host", ",".join(layers)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=ROOT,
            env={"PATH": os.environ["PATH"], "OPENBLAS_NUM_THREADS": "1"},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout

    def attack(self, name: str, *, untrusted: bool = False) -> Result:
        """Runs one of the attacks."""
        return self.run(name, ATTACKS[name], untrusted=untrusted)

    def run(self, name: str, source: str, *, untrusted: bool = False) -> Result:
        """Runs any script."""
        self._input.write(json.dumps([name, source, untrusted]).encode() + b"\n")
        self._input.flush()
        line = self._output.readline()
        assert line, "the attack host has ended: the attack reached it"
        return msgspec.json.decode(line, type=Result)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._input.close()
        self._process.wait(timeout=30)
        self._output.close()


def as_unprivileged_user() -> list[str]:
    """The prefix that runs a command as an unprivileged user, if root started the tests.

    That user cannot access root's folder. If Python or this repository is inside, the command runs in a mount namespace
    in which only these are visible.
    """
    needed = [Path(sys.prefix).resolve(), Path(sys.base_prefix), Path(sys.prefix), ROOT]
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
