"""This computer: Python, user, the agent's folder, disk, and what locks scripts in."""

import os
import platform
import shutil
import sqlite3
import stat
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from device_agent.cli.doctor.finding import Finding, ok, problem, warning
from device_agent.config.identity_store import IdentityStore
from device_agent.sandbox.host import SandboxHost
from device_agent.speech.espeak import PROGRAM

_OLDEST = (3, 11)
_LITTLE_BYTES = 500_000_000
_TOO_LITTLE_BYTES = 50_000_000
_SECRET = frozenset({"identity.pem"})


def python() -> Iterator[Finding]:
    """Version and system."""
    here = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if sys.version_info < _OLDEST:
        yield problem("python", here, f"Install Python {_OLDEST[0]}.{_OLDEST[1]} or newer.")
    elif sys.platform != "linux":
        yield warning("python", here, "All but movement scripts works here; these run on Linux only.")
    else:
        yield ok("python", here)


def user() -> Iterator[Finding]:
    """Nothing that the agent does needs root."""
    if not hasattr(os, "geteuid"):
        yield ok("user", "runs with the rights of whoever starts it")
    elif os.geteuid() == 0:
        yield warning(
            "user",
            "runs as root: a limit on processes does not bind root, and a fault here would be a fault of the machine",
            "Run the agent as a user of its own: docs/guides/install-an-agent.md, infra/systemd/telescope-agent.service.",
        )
    else:
        yield ok("user", f"runs as an unprivileged user (uid {os.geteuid()})")


def folder(store: IdentityStore) -> Iterator[Finding]:
    """Whether the agent can use its folder, and nobody else."""
    path = store.folder
    if not path.is_dir():
        yield problem(
            "folder", f"{path} does not exist", "Run `python -m device_agent enroll`, or name it with --store."
        )
        return
    if not os.access(path, os.R_OK | os.W_OK | os.X_OK):
        yield problem("folder", f"{path} cannot be written by this user", f"Make it this user's: chown -R USER {path}")
        return
    if not (path / "identity.pem").exists():
        yield problem("folder", f"{path} holds no agent", "Run `python -m device_agent enroll` first.")
        return
    if sys.platform != "win32":
        wrong = list(_too_open(path))
        yield from wrong
        if wrong:
            return
    yield ok("folder", f"{path} is this user's alone")


def _too_open(path: Path) -> Iterator[Finding]:
    for each in (path, *sorted(path.iterdir())):
        if each != path and not each.is_file():
            continue
        if stat.S_IMODE(each.stat().st_mode) & 0o077:
            mode = "700" if each == path else "600"
            if each.name in _SECRET:
                said = f"others on this machine can read {each}, and then speak as this robot"
                yield problem("folder", said, f"chmod {mode} {each}; if others use this machine, delete it and enroll.")
            else:
                yield warning("folder", f"others on this machine can read {each}", f"chmod {mode} {each}")


def disk(store: IdentityStore) -> Iterator[Finding]:
    """Room for the journal, and whether it can be read: the agent does not run without it."""
    existing = next(each for each in (store.folder, *store.folder.resolve().parents) if each.is_dir())
    free = shutil.disk_usage(existing).free
    said = f"{free / 1e9:.1f} GB free at {existing}"
    if free < _TOO_LITTLE_BYTES:
        yield problem("disk", said, "Make room: without its journal the agent obeys nothing.")
    elif free < _LITTLE_BYTES:
        yield warning("disk", said, "Make room soon: without its journal the agent obeys nothing.")
    else:
        yield ok("disk", said)
    for database in (store.journal, store.outbox):
        if database.exists():
            yield _readable(database)


def _readable(database: Path) -> Finding:
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=2)) as opened:
            said = str(opened.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.Error as error:
        said = str(error)
    if said == "ok":
        return ok("disk", f"{database.name} is whole")
    return problem(
        "disk",
        f"{database} is damaged: {said}",
        "Move it away. The agent then needs a new lease for each device, and what it had not sent yet is lost.",
    )


def scripts(*, trusted: bool) -> Iterator[Finding]:
    """Whether movement scripts can be locked in, here and now: by doing it."""
    jail = SandboxHost()
    try:
        jail.start()
        refusal = jail.refusal(stranger=False)
        strangers = jail.refusal(stranger=True) if refusal is None else None
        missing = jail.missing
    finally:
        jail.close()
    if refusal is None:
        yield ok("scripts", "limits, another user, Landlock and seccomp lock movement scripts in")
    elif trusted:
        lacks = ", ".join(f"{layer} ({why})" for layer, why in missing.items()) or "Linux"
        yield warning(
            "scripts",
            f"movement scripts run with this agent's rights, as its agent.toml wants it: there is no {lacks}",
            "Remove `allow_unconfined_scripts` from agent.toml unless you wrote every script yourself.",
        )
    elif sys.platform != "linux":
        yield warning("scripts", refusal, "Everything else works here.")
    else:
        yield warning("scripts", f"movement scripts are refused: {refusal}", "Without scripts everything else works.")
    if strangers is not None:
        yield warning("scripts", strangers, "Scripts of the robot's own account run without it.")


def voice() -> Iterator[Finding]:
    """Whether robots without a voice of their own can be heard."""
    if shutil.which(PROGRAM) is not None:
        yield ok("voice", f"{PROGRAM} turns what robots say into sound")
    else:
        yield warning(
            "voice",
            f"there is no {PROGRAM}: what robots say is shown as text alone",
            f"Install {PROGRAM} for sound (Debian: apt-get install {PROGRAM}).",
        )
