"""Checks of this computer: Python, user, folder, disk, speech and the script sandbox."""

import os
import platform
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from device_agent.cli.doctor.finding import Finding, ok, problem, warning
from device_agent.config.identity_store import IdentityStore
from device_agent.protocol.security import private_folder
from device_agent.sandbox.host import SandboxHost
from device_agent.speech.espeak import PROGRAM

_MIN_PYTHON = (3, 11)
_WARNING_BYTES = 500_000_000
_PROBLEM_BYTES = 50_000_000
_SECRET = frozenset({"identity.pem"})


def python() -> Iterator[Finding]:
    """Check the Python version and the operating system."""
    version = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if sys.version_info < _MIN_PYTHON:
        yield problem("python", version, f"Install Python {_MIN_PYTHON[0]}.{_MIN_PYTHON[1]} or newer.")
    elif sys.platform != "linux":
        yield warning("python", version, "Everything except movement scripts works here; scripts run on Linux only.")
    else:
        yield ok("python", version)


def user() -> Iterator[Finding]:
    """Check that the agent does not run as root."""
    if not hasattr(os, "geteuid"):
        yield ok("user", "runs with the rights of the user who starts it")
    elif os.geteuid() == 0:
        yield warning(
            "user",
            "runs as root: process limits do not apply to root, and a fault could affect the whole machine",
            "Run the agent as a dedicated user: docs/guides/install-an-agent.md.",
        )
    else:
        yield ok("user", f"runs as an unprivileged user (uid {os.geteuid()})")


def folder(store: IdentityStore) -> Iterator[Finding]:
    """Check that only the agent's user can use its folder."""
    path = store.folder
    if not path.is_dir():
        yield problem(
            "folder", f"{path} does not exist", "Run `python -m device_agent enroll`, or name it with --home."
        )
        return
    if not os.access(path, os.R_OK | os.W_OK | os.X_OK):
        yield problem("folder", f"{path} cannot be written by this user", f"Change its owner: chown -R USER {path}")
        return
    if not (path / "identity.pem").exists():
        yield problem("folder", f"{path} holds no agent", "Run `python -m device_agent enroll` first.")
        return
    findings = list(_readable_by_others(path))
    yield from findings
    if findings:
        return
    yield ok("folder", f"{path} is accessible to this user only")


def _readable_by_others(path: Path) -> Iterator[Finding]:
    for entry in private_folder.exposed(path):
        mode = "700" if entry.is_dir() else "600"
        if entry.name in _SECRET:
            message = f"other users of this machine can read {entry} and impersonate this agent"
            yield problem("folder", message, f"chmod {mode} {entry}; if others use this machine, delete it and enroll.")
        else:
            yield warning("folder", f"other users of this machine can read {entry}", f"chmod {mode} {entry}")


def disk(store: IdentityStore) -> Iterator[Finding]:
    """Check free space and integrity of the databases; the agent does not run without its journal."""
    existing = next(folder for folder in (store.folder, *store.folder.resolve().parents) if folder.is_dir())
    free = shutil.disk_usage(existing).free
    message = f"{free / 1e9:.1f} GB free at {existing}"
    if free < _PROBLEM_BYTES:
        yield problem("disk", message, "Free disk space: without its journal the agent rejects all commands.")
    elif free < _WARNING_BYTES:
        yield warning("disk", message, "Free disk space soon: without its journal the agent rejects all commands.")
    else:
        yield ok("disk", message)
    for database in (store.journal, store.outbox):
        if database.exists():
            yield _readable(database)


def _readable(database: Path) -> Finding:
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=2)) as connection:
            result = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
    except sqlite3.Error as error:
        result = str(error)
    if result == "ok":
        return ok("disk", f"{database.name} is intact")
    return problem(
        "disk",
        f"{database} is damaged: {result}",
        "Move it away. The agent then needs a new lease for each device, and unsent messages are lost.",
    )


def scripts(*, allow_unconfined: bool) -> Iterator[Finding]:
    """Check that movement scripts can be confined, by confining one."""
    sandbox = SandboxHost()
    try:
        sandbox.start()
        refusal = sandbox.refusal(untrusted=False)
        untrusted_refusal = sandbox.refusal(untrusted=True) if refusal is None else None
        missing = sandbox.missing
    finally:
        sandbox.close()
    if refusal is None:
        yield ok("scripts", "limits, another user, Landlock and seccomp confine movement scripts")
    elif allow_unconfined:
        lacks = ", ".join(f"{layer} ({reason})" for layer, reason in missing.items()) or "Linux"
        yield warning(
            "scripts",
            f"movement scripts run with this agent's rights, as agent.toml allows: this machine lacks {lacks}",
            "Remove `allow_unconfined_scripts` from agent.toml unless you wrote every script yourself.",
        )
    elif sys.platform != "linux":
        yield warning("scripts", refusal, "Everything else works here.")
    else:
        yield warning(
            "scripts", f"movement scripts are unavailable: {refusal}", "Without scripts everything else works."
        )
    if untrusted_refusal is not None:
        yield warning("scripts", untrusted_refusal, "Scripts of the agent's owner run without it.")


def voice() -> Iterator[Finding]:
    """Check that a speech synthesizer is installed."""
    if shutil.which(PROGRAM) is not None:
        yield ok("voice", f"{PROGRAM} is installed")
    else:
        yield warning(
            "voice",
            f"{PROGRAM} is not installed: speech of robots without a voice is shown as text only",
            f"Install {PROGRAM} for sound (Debian: apt-get install {PROGRAM}).",
        )
