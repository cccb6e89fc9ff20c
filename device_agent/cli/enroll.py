"""``enroll``: register the agent with the server and wait until an account claims it."""

import argparse
import sys
import time
from pathlib import Path

import msgspec

from device_agent import bootstrap, drivers, sensors
from device_agent.cli import claim_prompt, robot_types, systemd
from device_agent.cli.arguments import Commands, add_home, add_no_qr
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry, HttpPolling
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock
from device_agent.protocol.topics import ID_PATTERN, is_id
from device_agent.transports import factory
from device_agent.transports.http import responses
from device_agent.transports.http.client import Claim, CloudClient
from device_agent.transports.pairing_monitor import SOFTWARE, pairing_of

_LONG_POLL_S = 20.0


def add_commands(commands: Commands, home: Path) -> None:
    """Add ``enroll``."""
    parser = commands.add_parser("enroll", help="register this agent with a server and print a claim code")
    parser.add_argument("--server", help="URL of the Telescope server, for example https://telescope.example")
    parser.add_argument(
        "--ca", type=Path, metavar="FILE", help="certificate authority (PEM) of an https server; no other is trusted"
    )
    parser.add_argument("--name", help="display name of this agent (default: name of the folder)")
    parser.add_argument(
        "--device",
        action="append",
        metavar="NAME=TYPE[:DRIVER]",
        default=[],
        help="a device of this agent, for example arm=ur5 or door=camera:rtsp; may be repeated",
    )
    parser.add_argument(
        "--room",
        action="append",
        metavar="ROOM",
        default=[],
        help="a room with all its robots and devices, for example lab; may be repeated",
    )
    parser.add_argument(
        "--transport",
        choices=factory.names(),
        help="connection to the cloud: MQTT broker (mqtt, the default), HTTP requests (http) or XMPP (xmpp)",
    )
    parser.add_argument(
        "--poll",
        choices=("long", "plain"),
        help="with http: the cloud responds when a command arrives (long, the default) or immediately (plain)",
    )
    parser.add_argument("--poll-ms", type=int, metavar="MS", help="interval of plain polls [ms]")
    parser.add_argument(
        "--no-wait", action="store_true", help="print the claim code and exit; `run` then waits for the claim"
    )
    add_no_qr(parser)
    add_home(parser, home)
    parser.set_defaults(command=_enroll)


def announce(api: CloudClient, config: AgentConfig, *, qr: bool) -> Claim:
    """Register the agent, and show the claim code, with ``qr`` as a QR code too, if it is not claimed yet."""
    claim = api.enroll(
        name=config.name, software=SOFTWARE, transport=config.transport, devices=catalogue.enrolled_devices(config)
    )
    if claim.code is not None:
        claim_prompt.show(claim, config.server, qr=qr)
    return claim


def await_claim(store: IdentityStore, api: CloudClient, config: AgentConfig, claim: Claim, *, qr: bool) -> Pairing:
    """Wait until an account claims the agent, and save the pairing. Replaces expired claim codes."""
    expires_s = time.monotonic() + (claim.expires_in_s or 0)
    again = False
    while True:
        systemd.notify_watchdog()
        if claim.code is not None:
            claim_prompt.show_waiting(expires_s - time.monotonic(), again=again)
            again = True
        enrollment = api.enrollment(wait_s=_LONG_POLL_S if claim.code is not None else 0.0)
        if enrollment.get("state") == "claimed":
            pairing = pairing_of(responses.read(enrollment, responses.Claimed))
            store.save_pairing(pairing)
            if again and sys.stdout.isatty():
                print()  # ends the line of the waiting message
            # An account chooses its name but not its id; the console shows the same short id.
            print(f"paired with {pairing.account} #{pairing.owner[:6]}", flush=True)
            return pairing
        if time.monotonic() > expires_s:
            print("the claim code has expired; here is a new one", flush=True)
            claim = announce(api, config, qr=qr)
            again = False
            expires_s = time.monotonic() + (claim.expires_in_s or 0)


def _enroll(options: argparse.Namespace) -> int:
    store = IdentityStore(options.home)
    config = _config(options, store)
    config.save(store.folder)
    api = bootstrap.cloud_client(store, config, CloudClock(), create=True)
    claim = announce(api, config, qr=not options.no_qr)
    if not (options.no_wait and claim.code is not None):
        await_claim(store, api, config, claim, qr=not options.no_qr)
        # Only the claim tells whose robot types apply, so a misspelled type is reported here.
        robot_types.update(store)
    return 0


def _config(options: argparse.Namespace, store: IdentityStore) -> AgentConfig:
    """The saved configuration, updated by the options."""
    try:
        saved = AgentConfig.load(store.folder)
    except ConfigError:
        saved = None
    if saved is None and not options.device and not options.room:
        raise ConfigError("name the devices of this agent, for example `--device arm=ur5` or `--room lab`")
    server = options.server or (saved.server if saved else "")
    if not server.startswith(("http://", "https://")):
        raise ConfigError("name the server, for example `--server http://127.0.0.1:8080`")
    if options.ca and not server.startswith("https://"):
        raise ConfigError("--ca needs an https server; an http server has no certificate")
    config = AgentConfig(
        server=server,
        ca=store.pin_certificate_authority(options.ca) if options.ca else (saved.ca if saved else ""),
        name=options.name or (saved.name if saved else store.folder.resolve().name),
        transport=options.transport or (saved.transport if saved else factory.names()[0]),
        http=_polling(options, saved.http if saved else HttpPolling()),
        devices=_devices(options) or (saved.devices if saved else ()),
    )
    return config.with_manual_settings(saved) if saved else config


def _polling(options: argparse.Namespace, saved: HttpPolling) -> HttpPolling:
    arguments = {"poll": options.poll, "poll_ms": options.poll_ms}
    changed = {name: value for name, value in arguments.items() if value is not None}
    try:
        return msgspec.convert(msgspec.to_builtins(saved) | changed, HttpPolling)
    except msgspec.ValidationError as error:
        raise ConfigError(f"--poll-ms: {error}") from error


def _devices(options: argparse.Namespace) -> tuple[DeviceEntry, ...]:
    rooms = (entry for name in options.room for entry in catalogue.entries_of(name))
    return (*(_device(text) for text in options.device), *rooms)


def _device(text: str) -> DeviceEntry:
    name, equals, rest = text.partition("=")
    robot_type, _, driver = rest.partition(":")
    if not equals or not is_id(name):
        raise ConfigError(f"'{text}' is not NAME=TYPE; a name matches {ID_PATTERN}")
    if catalogue.is_device_type(robot_type):
        return _room_device(name, robot_type, driver)
    known = catalogue.TYPES.folders()
    label = catalogue.TYPES.load(robot_type).label if robot_type in known else ""
    if not is_id(robot_type):
        raise ConfigError(f"'{robot_type}' is not a robot type; known: {', '.join(known)}")
    if robot_type not in known:
        print(
            f"robot type '{robot_type}' is not on this machine (known: {', '.join(known)}); it is downloaded from "
            "the account that redeems the claim code",
            flush=True,
        )
    if driver:
        drivers.load(driver)
    return DeviceEntry(name=name, type=robot_type, driver=driver, label=label)


def _room_device(name: str, device_type: str, driver: str) -> DeviceEntry:
    if driver and driver not in sensors.names():
        raise ConfigError(f"no sensor driver '{driver}'; there are: {', '.join(sensors.names())}")
    label = catalogue.DEVICES.load(device_type).label
    return DeviceEntry(name=name, type=device_type, driver=driver, label=label)
