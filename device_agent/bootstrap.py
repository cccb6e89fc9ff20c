"""Puts an agent together: the one place that picks drivers; ``links`` picks the transport."""

from collections.abc import Callable
from pathlib import Path

from device_agent import drivers, geometry, links
from device_agent.jail.warm import WarmJail
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.geometry import Geometry, GeometryError
from device_agent.ports.jail import Jail
from device_agent.ports.transport import Transport
from device_agent.protocol import robot_type, topics
from device_agent.protocol.errors import ProtocolError
from device_agent.runtime.agent import Agent
from device_agent.runtime.device import Device
from device_agent.runtime.home import Configuration, DeviceEntry, Home, HomeError, Pairing
from device_agent.runtime.journal import Journal
from device_agent.runtime.outbox import Outbox, Publish
from device_agent.runtime.room import Room
from device_agent.runtime.shelf import Shelf
from device_agent.transports.http.api import CloudApi

ROBOTS = Path(__file__).resolve().parent.parent / "robots"


class Cell:
    """A running agent and what must be closed with it."""

    def __init__(self, agent: Agent, journal: Journal, membership: links.Membership, jail: Jail) -> None:
        self._agent = agent
        self._jail = jail
        self._journal = journal
        self._membership = membership

    @property
    def outdated(self) -> bool:
        """Whether the agent was un-paired, or moved: whose it is is to be asked, and all of it built again."""
        return self._membership.outdated.is_set()

    def start(self) -> None:
        """Start devices and link.

        Raises:
            DriverError: A device is not there.
            TransportError: The transport's configuration is unusable.
        """
        self._jail.start()
        self._agent.start()

    def stop(self) -> None:
        """Hold, say goodbye, close. May be called twice."""
        self._agent.stop()
        self._jail.close()
        self._journal.close()


def load_type(name: str) -> robot_type.RobotType:
    """A robot type of this installation.

    Raises:
        HomeError: Unknown, or its manifest is wrong; the text lists the known ones.
    """
    folder = ROBOTS / name
    if not (folder / robot_type.MANIFEST).is_file():
        known = sorted(path.parent.name for path in ROBOTS.glob(f"*/{robot_type.MANIFEST}"))
        raise HomeError(f"no robot type '{name}'; there are: {', '.join(known)}")
    try:
        return robot_type.load(folder)
    except ProtocolError as error:
        raise HomeError(str(error)) from error


def api_of(home: Home, configuration: Configuration, clock: CloudClock, *, create: bool = False) -> CloudApi:
    """The agent's view of the HTTP API.

    Raises:
        HomeError: There is no identity.
    """
    return CloudApi(configuration.server, home.identity(create=create), clock)


def enrolled_devices(configuration: Configuration) -> list[dict[str, str]]:
    """The devices as the cloud is told of them."""
    entries = []
    for device in configuration.devices:
        kind = load_type(device.type)
        entries.append(
            {"name": device.name, "kind": kind.kind, "robot_type": kind.type, "label": device.label or kind.label}
        )
    return entries


def build(home: Home, *, trace: Path | None = None) -> Cell:
    """An agent from its folder, ready to start.

    Args:
        home: Enrolled and claimed.
        trace: A folder into which simulated devices write what really happened, ``{device}.ndjson`` each.

    Raises:
        HomeError: Not enrolled, not claimed, or a file is wrong.
        JournalError: The journal cannot be used.
        DriverError: An unknown driver or option.
    """
    configuration = home.configuration()
    pairing = home.pairing()
    if pairing is None:
        raise HomeError(f"{home.folder} is not paired; run `python -m device_agent enroll` and redeem its claim code")
    clock = CloudClock()
    journal = Journal(home.journal)
    journal.open(now_ms=wall_ms())
    journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
    membership = links.Membership(pairing, configuration, enrolled_devices(configuration))
    room = Room(
        space=pairing.space,
        agent=pairing.agent,
        own=[entry.name for entry in configuration.devices],
        named=configuration.sources,
    )
    transport = links.make(
        links.Wiring(
            configuration=configuration,
            pairing=pairing,
            membership=membership,
            open_api=lambda: api_of(home, configuration, clock),
            next_session=journal.next_session,
            quiet=lambda: agent.quiet,
            listen=room.topics(),
        )
    )
    outbox = _outbox(home, configuration, pairing, publish=transport.publish, quiet=lambda: agent.quiet)
    jail = WarmJail(trusted=configuration.trusted_scripts)
    devices = {}
    for entry in configuration.devices:
        devices[entry.name] = _device(
            entry,
            pairing,
            journal=journal,
            clock=clock,
            transport=transport,
            outbox=outbox,
            room=room,
            jail=jail,
            trace=trace,
        )
    agent = Agent(devices, transport, outbox=outbox, room=room, address=(pairing.space, pairing.agent))
    return Cell(agent, journal, membership, jail)


def _outbox(
    home: Home,
    configuration: Configuration,
    pairing: Pairing,
    *,
    publish: Publish,
    quiet: Callable[[], bool],
) -> Outbox:
    own = f"{topics.ROOT}/{pairing.space}/{pairing.agent}/"
    buffer = configuration.buffer
    shelf = Shelf(
        home.outbox, own=own, max_bytes=round(buffer.max_mb * 1e6), max_age_ms=round(buffer.max_age_h * 3_600_000)
    )
    teller = own + configuration.devices[0].name
    # Over the others a message is confirmed once it is stored.
    settle_s = buffer.settle_s if configuration.transport == "mqtt" else 0.0
    return Outbox(shelf, publish=publish, teller=teller, quiet=quiet, keep_hz=buffer.measurements_hz, settle_s=settle_s)


def _device(
    entry: DeviceEntry,
    pairing: Pairing,
    *,
    journal: Journal,
    clock: CloudClock,
    transport: Transport,
    outbox: Outbox,
    room: Room,
    jail: Jail,
    trace: Path | None,
) -> Device:
    kind = load_type(entry.type)
    options: dict[str, object] = dict(entry.options)
    name = entry.driver or kind.driver
    if trace is not None and name == "mujoco":
        options["trace"] = str(trace / f"{entry.name}.ndjson")
    driver = drivers.load(name)(kind, ROBOTS / kind.type, options, entry.name)
    return Device(
        name=entry.name,
        label=entry.label or kind.label,
        space=pairing.space,
        agent=pairing.agent,
        robot_type=kind,
        driver=driver,
        journal=journal,
        cloud_clock=clock,
        keys=pairing.public_keys(),
        publish=transport.publish,
        outbox=outbox,
        room=room,
        interlocks=entry.interlocks,
        geometry=_geometry(kind, str(entry.options.get("scene", ""))),
        jail=jail,
        owner=pairing.owner,
    )


def _geometry(kind: robot_type.RobotType, scene: str) -> Geometry | None:
    try:
        return geometry.load(kind, ROBOTS / kind.type, scene=scene)
    except GeometryError as error:
        raise HomeError(str(error)) from error
