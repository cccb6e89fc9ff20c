"""``doctor``: check everything that the agent needs, and report problems with their remedies.

``machine`` checks this computer, ``devices`` the devices, ``cloud`` the server. A check yields findings, and
an exception in a check becomes a finding too.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import msgspec

from device_agent.cli.arguments import Commands, add_home
from device_agent.cli.doctor import cloud, devices, machine
from device_agent.cli.doctor.finding import Finding, problem
from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore

__all__ = ["Finding", "add_commands", "examine"]


def add_commands(commands: Commands, home: Path) -> None:
    """Add ``doctor``."""
    parser = commands.add_parser("doctor", help="check everything that the agent needs and suggest remedies")
    parser.add_argument("--json", action="store_true", help="print all findings as one JSON object")
    add_home(parser, home)
    parser.set_defaults(command=_doctor)


def examine(store: IdentityStore) -> Iterator[Finding]:
    """All findings, each as soon as it is known. Safe while the agent is running."""
    yield from _run("python", machine.python)
    yield from _run("user", machine.user)
    yield from _run("folder", partial(machine.folder, store))
    yield from _run("disk", partial(machine.disk, store))
    yield from _run("voice", machine.voice)
    try:
        config = AgentConfig.load(store.folder)
    except ConfigError as error:
        yield problem("agent", str(error), "Run `python -m device_agent enroll --server … --device NAME=TYPE`.")
        yield from _run("scripts", partial(machine.scripts, allow_unconfined=False))
        return
    yield from _run("scripts", partial(machine.scripts, allow_unconfined=config.allow_unconfined_scripts))
    yield from _run("renderer", partial(devices.renderer, config))
    for entry in config.devices:
        yield from _run(f"device {entry.name}", partial(devices.device, entry, store.folder))
    yield from _run("room", partial(devices.room, config))
    yield from _run("server", partial(cloud.examine, store, config))


def _run(name: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    try:
        yield from check()
    except Exception as error:  # noqa: BLE001 (an unforeseen failure of a check is a finding)
        yield problem(name, f"{type(error).__name__}: {error}", "This check failed; report it with the text above.")


def _doctor(options: argparse.Namespace) -> int:
    findings = []
    for finding in examine(IdentityStore(options.home)):
        findings.append(finding)
        if not options.json:
            print(f"{finding.level:8} {finding.check}: {finding.message}", flush=True)
            if finding.advice:
                print(f"{'':8} → {finding.advice}", flush=True)
    healthy = all(finding.level != "problem" for finding in findings)
    if options.json:
        print(msgspec.json.encode({"ok": healthy, "findings": findings}).decode())
    return 0 if healthy else 1
