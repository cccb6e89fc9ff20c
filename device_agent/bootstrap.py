"""Puts an agent together: the one place that picks drivers; ``links`` picks the transport."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import msgspec

from device_agent import drivers, geometry, sensors
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.catalogue import ROOMS, TYPES, enrolled_devices, room_device_of, type_of
from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.driver import Driver, DriverError
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import GeometryError, RobotGeometry
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.ports.transport import Transport
from device_agent.ports.uploads import Uploads
from device_agent.protocol import topics
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.shipped import ROBOTS
from device_agent.runtime.agent import Agent
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.device import Device
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.telemetry.latency_probe import LatencyProbe
from device_agent.runtime.telemetry.outbox import Outbox, Publish
from device_agent.sandbox.host import SandboxHost
from device_agent.speech import Espeak
from device_agent.transports import factory
from device_agent.transports.http.client import CloudClient
from device_agent.transports.http.latency_reports import HttpLatencies
from device_agent.transports.http.uploads import HttpUploads
from device_agent.transports.pairing_monitor import PairingMonitor


class RunningAgent:
    """A running agent and what must be closed with it."""

    def __init__(self, agent: Agent, journal: Journal, monitor: PairingMonitor, sandbox: Sandbox) -> None:
        self._agent = agent
        self._sandbox = sandbox
        self._journal = journal
        self._monitor = monitor

    @property
    def outdated(self) -> bool:
        """Whether the agent was un-paired, or moved: whose it is is to be asked, and all of it built again."""
        return self._monitor.outdated.is_set()

    def start(self) -> None:
        """Start devices and link.

        Raises:
            DriverError: A device is not there.
            TransportError: The transport's configuration is unusable.
        """
        self._sandbox.start()
        self._agent.start()

    def stop(self) -> None:
        """Hold, say goodbye, close. May be called twice."""
        self._agent.stop()
        self._sandbox.close()
        self._journal.close()


def check_robot_type(folder: Path) -> None:
    """Load all of a robot type in a folder, and connect its driver, a simulated one, for a moment.

    Raises:
        ConfigError: The manifest is wrong.
        GeometryError: The model cannot be used, or the home position has no room.
        DriverError: The driver refuses it.
    """
    kind = TYPES.load_from(folder)
    geometry.load(kind, folder)
    driver = drivers.load("mujoco")(kind, folder, {}, kind.type)
    driver.connect()
    driver.close()


def _folder(kind: RobotType) -> Path:
    """Where its files are. What a room's manifest describes has none."""
    return TYPES.folders().get(kind.type, ROBOTS / kind.type)


def load_geometry(entry: DeviceEntry, kind: RobotType) -> RobotGeometry | None:
    """The shape of a configured device in the scene or room that it stands in.

    Raises:
        GeometryError: The model cannot be used.
        ConfigError: The room is unknown.
    """
    scene, base_pose = str(entry.options.get("scene", "")), None
    if entry.room:
        room = ROOMS.load(entry.room)
        robot = room.robot(entry.name)
        if robot is not None and room.model:
            base_pose = geometry.BasePose(
                room=ROOMS.folder(room.room) / room.model, position_m=robot.position_m, yaw_rad=robot.yaw_rad
            )
    return geometry.load(kind, _folder(kind), scene=scene, base_pose=base_pose)


def create_driver(
    entry: DeviceEntry, kind: RobotType, *, trace: Path | None = None, faults: Path | None = None
) -> Driver:
    """The driver of a configured device, not connected.

    Args:
        entry: The device.
        kind: Its robot type.
        trace: A folder for what really happened, where it is simulated.
        faults: A folder for faults to put into simulated robots, ``{device}.toml`` each.

    Raises:
        DriverError: Unknown, or an option is.
    """
    options: dict[str, object] = dict(entry.options)
    name = entry.driver or kind.driver
    folder = _folder(kind)
    if name == "mujoco":
        if trace is not None:
            options["trace"] = str(trace / f"{entry.name}.ndjson")
        if faults is not None:
            options.setdefault("faults", str(faults / f"{entry.name}.toml"))
        if entry.room:
            options["room"] = str(ROOMS.folder(entry.room))
    return drivers.load(name)(kind, folder, options, entry.name)


def create_room_device(
    entry: DeviceEntry,
    neighbours: Mapping[str, RoomDriver],
    uploads: Uploads | None = None,
    *,
    faults: Path | None = None,
) -> RoomDevice | None:
    """A configured device as a room's, not connected; ``None`` where it is a robot.

    Args:
        entry: The device; its options stand before those of the room's manifest.
        neighbours: The agent's room drivers by name, filled while they are made.
        uploads: Where its captures go, if anywhere.
        faults: A folder for faults to put into simulated devices, ``{device}.toml`` each.

    Raises:
        ConfigError: The room is unknown, or its driver or an option.
    """
    device = room_device_of(entry)
    if device is None:
        return None
    driver = entry.driver or device.driver
    options = {**device.options, **entry.options}
    if driver == "mujoco" and faults is not None:
        options.setdefault("faults", str(faults / f"{entry.name}.toml"))
    manifest = msgspec.structs.replace(device, label=entry.label or device.label, driver=driver, options=options)
    try:
        made = sensors.load(driver)(manifest, ROOMS.folder(entry.room), _surroundings(entry.room, neighbours))
        return RoomDevice(made, manifest, uploads)
    except SensorError as error:
        raise ConfigError(str(error)) from error


def _surroundings(room: str, neighbours: Mapping[str, RoomDriver]) -> Surroundings:
    if not ROOMS.load(room).model:
        return Surroundings(neighbours=neighbours)
    from device_agent.simulation import world_registry  # noqa: PLC0415 (a real room needs no simulation)

    try:
        return Surroundings(neighbours=neighbours, world=world_registry.get_world(ROOMS.folder(room)))
    except DriverError as error:
        raise ConfigError(str(error)) from error


def cloud_client(
    store: IdentityStore, configuration: AgentConfig, clock: CloudClock, *, create: bool = False
) -> CloudClient:
    """The agent's view of the HTTP API.

    Raises:
        ConfigError: There is no identity.
    """
    return CloudClient(
        configuration.server, store.private_key(create=create), clock, ca=store.certificate_authority(configuration.ca)
    )


def build(store: IdentityStore, *, trace: Path | None = None) -> RunningAgent:
    """An agent from its folder, ready to start.

    Args:
        store: Enrolled and claimed.
        trace: A folder into which simulated devices write what really happened, ``{device}.ndjson`` each.

    Raises:
        ConfigError: Not enrolled, not claimed, or a file is wrong.
        JournalError: The journal cannot be used.
        DriverError: An unknown driver or option.
    """
    configuration = AgentConfig.load(store.folder)
    pairing = store.pairing()
    if pairing is None:
        raise ConfigError(
            f"{store.folder} is not paired; run `python -m device_agent enroll` and redeem its claim code"
        )
    clock = CloudClock()
    journal = Journal(store.journal)
    journal.open(now_ms=wall_ms())
    journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
    pins = PinnedKeys(pairing, save=store.save_pairing, now_ms=clock.now_ms)
    monitor = PairingMonitor(pairing, configuration, enrolled_devices(configuration), pins)
    room = ReadingCache(
        space=pairing.space,
        agent=pairing.agent,
        own=[entry.name for entry in configuration.devices],
        named=(*configuration.room_sources, *_own_streams(configuration)),
    )
    wiring = factory.Wiring(
        configuration=configuration,
        pairing=pairing,
        pairing_monitor=monitor,
        open_api=lambda: cloud_client(store, configuration, clock),
        next_session=journal.next_session,
        quiet=lambda: agent.quiet,
        certificate=ClientCertificate(store.folder),
        now_ms=clock.now_ms,
        listen=room.topics(),
    )
    latencies = HttpLatencies(pairing.agent, _carrier(configuration), wiring.open_api)
    transport = LatencyProbe(
        factory.make(wiring), upload=latencies.tell, at_ms=lambda: round(clock.now_ms() or wall_ms())
    )
    outbox = _outbox(store, configuration, pairing, publish=transport.publish, quiet=lambda: agent.quiet)
    sandbox = SandboxHost(allow_unconfined=configuration.allow_unconfined_scripts)
    uploads = HttpUploads(pairing.agent, lambda: cloud_client(store, configuration, clock))
    devices: dict[str, Device] = {}
    neighbours: dict[str, RoomDriver] = {}
    for entry in configuration.devices:
        instrument = create_room_device(entry, neighbours, uploads, faults=store.faults)
        if instrument is not None:
            neighbours[entry.name] = instrument.driver
        devices[entry.name] = _device(
            entry,
            pairing,
            pins=pins,
            instrument=instrument,
            ground=(lambda: _ground(neighbours)) if entry.room else None,
            journal=journal,
            clock=clock,
            transport=transport,
            outbox=outbox,
            room=room,
            sandbox=sandbox,
            trace=trace,
            faults=store.faults,
            uploads=uploads,
        )
    agent = Agent(devices, transport, outbox=outbox, readings=room, address=(pairing.space, pairing.agent))
    return RunningAgent(agent, journal, monitor, sandbox)


def _carrier(configuration: AgentConfig) -> str:
    """What carries messages, as the cloud tells it apart."""
    plain = configuration.transport == "http" and configuration.http.poll == "plain"
    return "http-poll" if plain else configuration.transport


def _own_streams(configuration: AgentConfig) -> Iterator[tuple[str, str]]:
    """Device and stream of all that the agent's own room devices measure: its scripts need not name them."""
    for entry in configuration.devices:
        device = room_device_of(entry)
        for stream in () if device is None else device.streams:
            yield entry.name, stream.name


def _ground(neighbours: Mapping[str, RoomDriver]) -> ObstacleMap | None:
    """What stands in the room, where a device of this agent sees it now."""
    from device_agent.sensors.perception.driver import PerceptionDriver  # noqa: PLC0415 (for who goes somewhere only)

    for driver in neighbours.values():
        if isinstance(driver, PerceptionDriver):
            with contextlib.suppress(SensorError):
                return driver.grid
    return None


def _outbox(
    store: IdentityStore,
    configuration: AgentConfig,
    pairing: Pairing,
    *,
    publish: Publish,
    quiet: Callable[[], bool],
) -> Outbox:
    own = f"{topics.ROOT}/{pairing.space}/{pairing.agent}/"
    buffer = configuration.buffer
    shelf = OutboxStore(
        store.outbox, own=own, max_bytes=round(buffer.max_mb * 1e6), max_age_ms=round(buffer.max_age_h * 3_600_000)
    )
    teller = own + configuration.devices[0].name
    # Over the others a message is confirmed once it is stored.
    settle_s = buffer.settle_s if configuration.transport == "mqtt" else 0.0
    return Outbox(
        shelf, publish=publish, device_topic=teller, is_quiet=quiet, keep_hz=buffer.measurements_hz, settle_s=settle_s
    )


def _device(
    entry: DeviceEntry,
    pairing: Pairing,
    *,
    pins: PinnedKeys,
    instrument: RoomDevice | None,
    ground: Callable[[], ObstacleMap | None] | None,
    journal: Journal,
    clock: CloudClock,
    transport: Transport,
    outbox: Outbox,
    room: ReadingCache,
    sandbox: Sandbox,
    trace: Path | None,
    faults: Path,
    uploads: Uploads,
) -> Device:
    kind = type_of(entry)
    return Device(
        name=entry.name,
        label=entry.label or kind.label,
        space=pairing.space,
        agent=pairing.agent,
        robot_type=kind,
        obstacle_map=ground,
        driver=create_driver(entry, kind, trace=trace, faults=faults) if instrument is None else instrument,
        journal=journal,
        cloud_clock=clock,
        keys=pins,
        publish=transport.publish,
        outbox=outbox,
        readings=room,
        interlocks=entry.interlocks,
        geometry=_geometry(entry, kind),
        sandbox=sandbox,
        owner=pairing.owner,
        speech=Espeak(),
        uploads=uploads,
    )


def _geometry(entry: DeviceEntry, kind: RobotType) -> RobotGeometry | None:
    try:
        return load_geometry(entry, kind)
    except GeometryError as error:
        raise ConfigError(str(error)) from error
