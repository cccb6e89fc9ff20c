"""``devices`` and ``repin``: list what the agent knows; pin the server's current keys."""

import argparse
from pathlib import Path

from device_agent import bootstrap, drivers, sensors
from device_agent.cli.arguments import Commands, add_home
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore
from device_agent.ports.clock import CloudClock
from device_agent.transports.http import responses
from device_agent.transports.pairing_monitor import pairing_of


def add_commands(commands: Commands, home: Path) -> None:
    """Add ``repin`` and ``devices``."""
    repin = commands.add_parser("repin", help="pin the server's current signing keys, after a long time offline")
    repin.set_defaults(command=_repin)
    devices = commands.add_parser("devices", help="list this agent's devices, and known robot types, rooms and drivers")
    devices.set_defaults(command=_devices)
    for parser in (repin, devices):
        add_home(parser, home)


def _repin(options: argparse.Namespace) -> int:
    """Replace the pinned keys. As at enrollment, the person at the machine confirms the server's identity."""
    store = IdentityStore(options.home)
    with store.lock():
        old = store.pairing()
        if old is None:
            raise ConfigError("this agent is not paired and has no pinned keys; run `python -m device_agent enroll`")
        config = AgentConfig.load(store.folder)
        enrollment = bootstrap.cloud_client(store, config, CloudClock()).enrollment()
        if enrollment.get("state") != "claimed":
            raise ConfigError("the agent was unpaired; `python -m device_agent run` shows a new claim code")
        new = pairing_of(responses.read(enrollment, responses.Claimed))
        if new.serial < old.serial:
            raise ConfigError(
                f"the server's newest key is number {new.serial}, older than the pinned number {old.serial}: it is "
                "another server, or one restored from an old backup. If you trust it, unpair the agent there and claim "
                "it again"
            )
        store.save_pairing(new)
    for name in sorted(set(new.keys) - set(old.keys)):
        print(f"pinned key {name}; compare it with the output of `rotate-keys` at the server")
    print(f"{len(new.keys)} keys of the server are pinned; the newest is number {new.serial}")
    return 0


def _devices(options: argparse.Namespace) -> int:
    try:
        for device in AgentConfig.load(options.home).devices:
            print(f"device  {device.name}: {device.type}, {device.driver or catalogue.type_of(device).driver}")
    except ConfigError as error:
        print(error)
    for name in catalogue.TYPES.folders():
        print(f"type    {name}: {catalogue.TYPES.load(name).label}")
    for name in catalogue.DEVICES.folders():
        print(f"type    {name}: {catalogue.DEVICES.load(name).label}")
    for name in catalogue.ROOMS.folders():
        print(f"room    {name}: {catalogue.ROOMS.load(name).label}")
    for name in drivers.names():
        print(f"driver  {name}")
    for name in sensors.names():
        print(f"sensor  {name}")
    return 0
