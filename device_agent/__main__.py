"""``python -m device_agent enroll|run|doctor|repin|devices|import-model|swarm``: the agent's command line."""

import argparse
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from device_agent import bootstrap, drivers, sensors
from device_agent.cli import claim_prompt, doctor, systemd
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry, HttpPolling
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.load_generator.options import SwarmError, add_options, plan_of
from device_agent.ports.clock import CloudClock
from device_agent.ports.driver import DriverError
from device_agent.ports.geometry import GeometryError
from device_agent.ports.transport import TransportError
from device_agent.protocol.topics import ID_PATTERN, is_id
from device_agent.runtime.storage.journal import JournalError
from device_agent.transports import factory
from device_agent.transports.http import responses
from device_agent.transports.http.client import Claim, CloudClient, CloudError

_POLL_S = 20.0
_OUTDATED_POLL_S = 0.5
_AGAIN_S = 5.0
_TURN_S = 0.001
_EXIT_FAILED = 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    os.umask(0o077)  # what the agent writes is nobody else's to read
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    try:
        code: int = options.command(options)
    except (ConfigError, JournalError, DriverError, TransportError, CloudError, SwarmError, OSError) as error:
        print(f"telescope agent: {error}", file=sys.stderr)
        return _EXIT_FAILED
    except KeyboardInterrupt:
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m device_agent", description="The Telescope agent of a robot.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    default = Path(os.environ.get("TELESCOPE_AGENT_HOME", Path.home() / ".telescope-agent"))

    enroll = commands.add_parser("enroll", help="make this agent known and print a claim code")
    enroll.add_argument("--server", help="address of the Telescope server, http://host:port")
    enroll.add_argument(
        "--ca", type=Path, metavar="FILE", help="the authority (PEM) that alone may speak for an https server"
    )
    enroll.add_argument("--name", help="name of this agent, for people (default: the folder's name)")
    enroll.add_argument(
        "--device",
        action="append",
        metavar="NAME=TYPE[:DRIVER]",
        default=[],
        help="a device behind this agent, for example arm=ur5; may be given several times",
    )
    enroll.add_argument(
        "--room",
        action="append",
        metavar="ROOM",
        default=[],
        help="a simulated room with all that is in it, for example lab; may be given several times",
    )
    enroll.add_argument(
        "--transport",
        choices=factory.names(),
        help="how the cloud is reached: by a broker (mqtt, the default), by requests alone (http), or by XMPP (xmpp)",
    )
    enroll.add_argument(
        "--poll",
        choices=("long", "plain"),
        help="with http: the cloud answers when there is something (long, the default), or at once (plain)",
    )
    enroll.add_argument("--poll-ms", type=int, metavar="MS", help="with plain polls: one each so many ms")
    enroll.add_argument(
        "--no-wait", action="store_true", help="print the code and leave; `run` then waits for the claim"
    )
    enroll.set_defaults(command=_enroll)

    run = commands.add_parser("run", help="run the agent until it is told to end (Ctrl-C, SIGTERM)")
    run.add_argument("--trace", type=Path, metavar="FOLDER", help="simulated devices write what really happened here")
    run.set_defaults(command=_run)

    examine = commands.add_parser("doctor", help="look whether everything is there that the agent needs")
    examine.add_argument("--json", action="store_true", help="for programs: one object with all findings")
    examine.set_defaults(command=_doctor)

    repin = commands.add_parser("repin", help="trust the keys that the server signs with now, after a long absence")
    repin.set_defaults(command=_repin)

    devices = commands.add_parser("devices", help="list this agent's devices, and known robot types, rooms and drivers")
    devices.set_defaults(command=_devices)

    take_over = commands.add_parser("import-model", help="make a robot type folder from a MuJoCo model")
    take_over.add_argument("model", type=Path, help="MJCF file of the robot, alone or in a scene")
    take_over.add_argument("--name", required=True, help="of the new robot type")
    take_over.add_argument(
        "--into", type=Path, default=Path(), metavar="FOLDER", help="where it is put (default: the current folder)"
    )
    take_over.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="ACTUATOR",
        help="leave it out; may be given several times",
    )
    take_over.set_defaults(command=_import_model)

    swarm = commands.add_parser("swarm", help="many agents without physics in one process, to try a server with")
    add_options(swarm)
    swarm.set_defaults(command=_swarm)

    for command in (enroll, run):
        command.add_argument(
            "--no-qr", action="store_true", help="print code and link without the QR code, even on a terminal"
        )
    for command in (enroll, run, examine, repin, devices):
        command.add_argument("--home", type=Path, default=default, help="the agent's folder (default: %(default)s)")
    return parser


# ------------------------------------------------------------ enroll


def _enroll(options: argparse.Namespace) -> int:
    store = IdentityStore(options.home)
    configuration = _configuration(options, store)
    configuration.save(store.folder)
    api = bootstrap.api_of(store, configuration, CloudClock(), create=True)
    claim = _announce(api, configuration, qr=not options.no_qr)
    if options.no_wait and claim.code is not None:
        return 0
    _await_claim(store, api, configuration, claim, qr=not options.no_qr)
    return 0


def _configuration(options: argparse.Namespace, store: IdentityStore) -> AgentConfig:
    """What is on file, with what was said now in its place."""
    try:
        before = AgentConfig.load(store.folder)
    except ConfigError:
        before = None
    if before is None and not options.device and not options.room:
        raise ConfigError("say which devices it has, for example `--device arm=ur5` or `--room lab`")
    server = options.server or (before.server if before else "")
    if not server.startswith(("http://", "https://")):
        raise ConfigError("say where the server is, for example `--server http://127.0.0.1:8080`")
    if options.ca and not server.startswith("https://"):
        raise ConfigError("--ca says who may speak for an https server; this one speaks http, which nobody vouches for")
    polling = _polling(options, before.http if before else HttpPolling())
    said = AgentConfig(
        server=server,
        ca=store.pin_certificate_authority(options.ca) if options.ca else (before.ca if before else ""),
        name=options.name or (before.name if before else store.folder.resolve().name),
        transport=options.transport or (before.transport if before else factory.names()[0]),
        http=polling,
        devices=_entries(options) or (before.devices if before else ()),
    )
    return said.with_manual_settings(before) if before else said


def _polling(options: argparse.Namespace, before: HttpPolling) -> HttpPolling:
    said = {"poll": options.poll, "poll_ms": options.poll_ms}
    try:
        changed = {name: value for name, value in said.items() if value is not None}
        return msgspec.convert(msgspec.to_builtins(before) | changed, HttpPolling)
    except msgspec.ValidationError as error:
        raise ConfigError(f"--poll-ms: {error}") from error


def _entries(options: argparse.Namespace) -> tuple[DeviceEntry, ...]:
    entries = [_entry(text) for text in options.device]
    for name in options.room:
        entries += catalogue.entries_of(name)
    return tuple(entries)


def _entry(text: str) -> DeviceEntry:
    name, equals, rest = text.partition("=")
    kind, _, driver = rest.partition(":")
    if not equals or not is_id(name):
        raise ConfigError(f"'{text}' is not NAME=TYPE; a name is {ID_PATTERN}")
    label = catalogue.TYPES.load(kind).label
    if driver:
        drivers.load(driver)
    return DeviceEntry(name=name, type=kind, driver=driver, label=label)


def _announce(api: CloudClient, configuration: AgentConfig, *, qr: bool) -> Claim:
    claim = api.enroll(
        name=configuration.name,
        software=factory.SOFTWARE,
        transport=configuration.transport,
        devices=catalogue.enrolled_devices(configuration),
    )
    if claim.code is not None:
        claim_prompt.show(claim, configuration.server, qr=qr)
    return claim


def _await_claim(
    store: IdentityStore, api: CloudClient, configuration: AgentConfig, claim: Claim, *, qr: bool
) -> Pairing:
    """Wait until somebody redeems the code; a code that runs out is replaced."""
    expires_s = time.monotonic() + (claim.expires_in_s or 0)
    while True:
        systemd.alive()
        found = api.enrollment(wait_s=_POLL_S if claim.code is not None else 0.0)
        if found.get("state") == "claimed":
            claimed = responses.read(found, responses.Claimed)
            pairing = factory.pairing_of(claimed)
            store.save_pairing(pairing)
            print(f"paired with {pairing.account}", flush=True)
            return pairing
        if time.monotonic() > expires_s:
            claim = _announce(api, configuration, qr=qr)
            expires_s = time.monotonic() + (claim.expires_in_s or 0)


# ------------------------------------------------------------ run


def _run(options: argparse.Namespace) -> int:
    store = IdentityStore(options.home)
    with store.lock():
        if store.pairing() is None:
            _pair(store, qr=not options.no_qr)
        if options.trace is not None:
            options.trace.mkdir(parents=True, exist_ok=True)
        while _run_until_told(store, options.trace):
            _pair(store, qr=not options.no_qr)
    return 0


def _pair(store: IdentityStore, *, qr: bool) -> None:
    """Learn whose the agent is; where it is nobody's, show a code and wait to be claimed.

    A robot may start before its network does: where the cloud is not reached it is asked again.
    """
    configuration = AgentConfig.load(store.folder)
    systemd.ready("waiting to be claimed")
    before = signal.signal(signal.SIGTERM, _leave)
    try:
        while True:
            api = bootstrap.api_of(store, configuration, CloudClock())
            try:
                _await_claim(store, api, configuration, _announce(api, configuration, qr=qr), qr=qr)
            except OSError as error:
                print(f"telescope agent: {error}; trying again in {_AGAIN_S:.0f} s", file=sys.stderr, flush=True)
                time.sleep(_AGAIN_S)
            else:
                return
    finally:
        signal.signal(signal.SIGTERM, before)


def _leave(*_: object) -> None:
    """Nothing runs yet that would have to be ended first."""
    raise SystemExit(0)


def _run_until_told(store: IdentityStore, trace: Path | None) -> bool:
    """Run as the pairing on file says, until told to end; whether instead the pairing no longer holds."""
    ending = threading.Event()
    before = {number: signal.signal(number, lambda *_: ending.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    cell = bootstrap.build(store, trace=trace)
    try:
        cell.start()
        _let_control_loops_go_first()
        print("running", flush=True)
        systemd.ready("running")
        while not ending.wait(_OUTDATED_POLL_S):
            systemd.alive()
            if cell.outdated:
                return True
    finally:
        cell.stop()
        for number, handler in before.items():
            signal.signal(number, handler)
    return False


def _let_control_loops_go_first() -> None:
    """Shorten what a control loop may have to wait for in this process; docs/results/measured.md has the figures.

    A thread that computes gives way after a millisecond, not five; and the collector leaves alone what was made at the
    start and stays: to go through all of it took 40 ms, in which nothing else ran.
    """
    sys.setswitchinterval(_TURN_S)
    gc.collect()
    gc.freeze()


# ------------------------------------------------------------ doctor


def _doctor(options: argparse.Namespace) -> int:
    found = []
    for finding in doctor.examine(IdentityStore(options.home)):
        found.append(finding)
        if not options.json:
            print(f"{finding.level:8} {finding.check}: {finding.message}", flush=True)
            if finding.advice:
                print(f"{'':8} → {finding.advice}", flush=True)
    good = all(finding.level != "problem" for finding in found)
    if options.json:
        print(msgspec.json.encode({"ok": good, "findings": found}).decode())
    return 0 if good else _EXIT_FAILED


# ------------------------------------------------------------ repin


def _repin(options: argparse.Namespace) -> int:
    """As at the first enrolment, whoever is at the machine vouches for the server; the pairing stays as it is."""
    store = IdentityStore(options.home)
    with store.lock():
        before = store.pairing()
        if before is None:
            raise ConfigError("this agent is not paired, so it has pinned nothing; run `python -m device_agent enroll`")
        found = bootstrap.api_of(store, AgentConfig.load(store.folder), CloudClock()).enrollment()
        if found.get("state") != "claimed":
            raise ConfigError("the agent was un-paired; `python -m device_agent run` shows a new claim code")
        after = factory.pairing_of(responses.read(found, responses.Claimed))
        if after.serial < before.serial:
            raise ConfigError(
                f"the server's newest key is number {after.serial}, older than number {before.serial}, which is "
                "pinned: it is another server, or one put back to an old state. If you trust it, un-pair the agent "
                "there and claim it again"
            )
        store.save_pairing(after)
    for name in sorted(set(after.keys) - set(before.keys)):
        print(f"pinned key {name}; `rotate-keys` has named it at the server")
    print(f"obeys {len(after.keys)} of the server's keys, the newest number {after.serial}")
    return 0


# ------------------------------------------------------------ devices


def _devices(options: argparse.Namespace) -> int:
    store = IdentityStore(options.home)
    try:
        for device in AgentConfig.load(store.folder).devices:
            print(f"device  {device.name}: {device.type}, {device.driver or catalogue.type_of(device).driver}")
    except ConfigError as error:
        print(error)
    for name in catalogue.TYPES.folders():
        print(f"type    {name}: {catalogue.TYPES.load(name).label}")
    for name in catalogue.ROOMS.folders():
        print(f"room    {name}: {catalogue.ROOMS.load(name).label}")
    for name in drivers.names():
        print(f"driver  {name}")
    for name in sensors.names():
        print(f"sensor  {name}")
    return 0


# ------------------------------------------------------------ swarm


def _swarm(options: argparse.Namespace) -> int:
    # Read here: only Unix has what it is made of.
    from device_agent.load_generator import run  # noqa: PLC0415

    return run.run(plan_of(options))


# ------------------------------------------------------------ import-model


def _import_model(options: argparse.Namespace) -> int:
    # Read here: whoever only runs real robots may have no MuJoCo.
    from device_agent.simulation.mjcf.import_model import AdoptError, adopt  # noqa: PLC0415

    try:
        folder = adopt(options.model, options.name, options.into, without=options.without)
    except AdoptError as error:
        raise ConfigError(str(error)) from error
    print(f"made {folder.resolve()}; look at what its robot.toml calls guessed")
    try:
        bootstrap.try_type(folder)
    except (ConfigError, DriverError, GeometryError) as error:
        print(f"it does not run yet: {error}", file=sys.stderr)
        return _EXIT_FAILED
    print(f"it runs; name {folder.resolve().parent} in {catalogue.ROBOTS_PATH} to use it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
