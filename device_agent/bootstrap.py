"""Composition root: builds the agent from its configuration. The only place that selects drivers."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from device_agent import drivers, geometry, sensors
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.catalogue import ROOMS, TYPES, enrolled_devices, room_device_of, tasks_of, type_of
from device_agent.config.client_certificate import ClientCertificate
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.ports.driver import Driver, DriverError
from device_agent.ports.floor_map import ObstacleMap
from device_agent.ports.geometry import RobotGeometry
from device_agent.ports.sandbox import Sandbox
from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.ports.tracing import CommandTraces
from device_agent.ports.transport import Transport
from device_agent.ports.uploads import Uploads
from device_agent.protocol import topics
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.protocol.manifests.shipped import ROBOTS
from device_agent.runtime.actions.task_monitors import TaskMonitors
from device_agent.runtime.agent import Agent
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.device import Device
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.recording import camera_recorder
from device_agent.runtime.recording import recorder as recording
from device_agent.runtime.recording.recorder import Recorder
from device_agent.runtime.room.room_device import RoomDevice
from device_agent.runtime.storage.journal import Journal
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.supervision import Supervisor
from device_agent.runtime.telemetry.latency_probe import LatencyProbe
from device_agent.runtime.telemetry.outbox import Outbox, Publish
from device_agent.sandbox.host import SandboxHost
from device_agent.speech import Espeak
from device_agent.transports import factory
from device_agent.transports.http.client import CloudClient
from device_agent.transports.http.latency_reports import LatencyReports
from device_agent.transports.http.recording_uploads import HttpRecordingUploads
from device_agent.transports.http.uploads import HttpUploads
from device_agent.transports.pairing_monitor import PairingMonitor

if TYPE_CHECKING:
    from device_agent.transports.metrics import AgentMetrics  # its package is optional


@dataclass(eq=False, slots=True)
class RunningAgent:
    """An agent and the resources to close with it. While it runs, the caller must check its ``supervisor``."""

    agent: Agent
    _journal: Journal
    _monitor: PairingMonitor
    _sandbox: Sandbox
    supervisor: Supervisor
    _recorder: Recorder | None

    @property
    def outdated(self) -> bool:
        """Whether the agent was unpaired or moved to another space, and must be built again."""
        return self._monitor.outdated.is_set()

    def start(self) -> None:
        """Start sandbox, devices and link.

        Raises:
            DriverError: A device is missing.
            TransportError: The configuration of the transport is unusable.
        """
        self._sandbox.start()
        if self._recorder is not None:
            self._recorder.start()
        self.agent.start()
        self.supervisor.start()

    def stop(self) -> None:
        """Hold, disconnect and close. May be called repeatedly."""
        self.supervisor.stop()
        if self._recorder is not None:
            self._recorder.stop_cameras()
        self.agent.stop()
        if self._recorder is not None:
            self._recorder.stop()
        self._sandbox.close()
        self._journal.close()


def _folder(kind: RobotType) -> Path:
    """Folder of a robot type; types derived from a room's manifest have none."""
    return TYPES.folders().get(kind.type, ROBOTS / kind.type)


def load_geometry(entry: DeviceEntry, kind: RobotType) -> RobotGeometry | None:
    """Geometry of a device in its scene or room.

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
    """Create the driver of a device, not connected.

    Args:
        entry: The device.
        kind: Its robot type.
        trace: Folder for the ground truth of simulated devices.
        faults: Folder of injected faults of simulated robots, ``{device}.toml`` each.

    Raises:
        DriverError: The driver or an option is unknown.
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
    home: Path,
    faults: Path | None = None,
) -> RoomDevice | None:
    """Create a room device, not connected; ``None`` for a robot.

    Args:
        entry: The device; its options override those of the room's manifest.
        neighbours: The agent's room drivers by name, completed while they are created.
        uploads: Destination of captures.
        home: The agent's folder; files that ``agent.toml`` names are relative to it.
        faults: Folder of injected faults of simulated devices, ``{device}.toml`` each.

    Raises:
        ConfigError: The room, the driver or an option is unknown.
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
        folder = ROOMS.folder(entry.room) if entry.room else home
        sensor = sensors.load(driver)(manifest, folder, _surroundings(entry.room, neighbours))
        return RoomDevice(sensor, manifest, uploads)
    except SensorError as error:
        raise ConfigError(str(error)) from error


def _surroundings(room: str, neighbours: Mapping[str, RoomDriver]) -> Surroundings:
    if not room or not ROOMS.load(room).model:
        return Surroundings(neighbours=neighbours)
    from device_agent.simulation import world_registry  # noqa: PLC0415 (a real room needs no simulation)

    try:
        return Surroundings(neighbours=neighbours, world=world_registry.get_world(ROOMS.folder(room)))
    except DriverError as error:
        raise ConfigError(str(error)) from error


def simulates(configuration: AgentConfig) -> bool:
    """Whether MuJoCo simulates a device of this agent."""
    return any(_driver_of(entry) == "mujoco" for entry in configuration.devices)


def _driver_of(entry: DeviceEntry) -> str:
    with contextlib.suppress(ConfigError):
        return entry.driver or type_of(entry).driver
    return ""


def cloud_client(
    store: IdentityStore, configuration: AgentConfig, clock: CloudClock, *, create: bool = False
) -> CloudClient:
    """HTTP API client of the agent.

    Raises:
        ConfigError: The agent has no private key.
    """
    return CloudClient(
        configuration.server, store.private_key(create=create), clock, ca=store.certificate_authority(configuration.ca)
    )


def build(
    store: IdentityStore,
    *,
    trace: Path | None = None,
    metrics: "AgentMetrics | None" = None,
    traces: CommandTraces | None = None,
) -> RunningAgent:
    """Build the agent of an enrolled and claimed ``store``, ready to start; ``metrics`` and ``traces`` measure it.

    ``trace``: folder for the ground truth of simulated devices, ``{device}.ndjson`` each.

    Raises:
        ConfigError: The agent is not enrolled or claimed, or a file is wrong.
        GeometryError: The model of a device cannot be used.
        JournalError: The journal cannot be used.
        DriverError: A driver or option is unknown.
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
    pins = PinnedKeys(pairing, identity=store.private_key(), save=store.save_pairing, now_ms=clock.now_ms)
    monitor = PairingMonitor(pairing, configuration, enrolled_devices(configuration), pins)
    readings = ReadingCache(
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
        listen=readings.topics(),
    )
    latencies = LatencyReports(pairing.agent, configuration.transport_name, wiring.open_api)
    link = factory.make(wiring)
    transport = LatencyProbe(
        link if metrics is None else metrics.measured(link),
        upload=latencies.send,
        at_ms=lambda: round(clock.now_ms() or wall_ms()),
    )
    outbox = _outbox(store, configuration, pairing, publish=transport.publish, quiet=lambda: agent.quiet)
    sandbox = SandboxHost(allow_unconfined=configuration.allow_unconfined_scripts)
    uploads = HttpUploads(pairing.agent, lambda: cloud_client(store, configuration, clock))
    room_devices: dict[str, RoomDevice] = {}
    recorder = recording.create(
        configuration.recording,
        store.recordings,
        owner=f"{pairing.space}/{pairing.owner}",
        uploads=HttpRecordingUploads(pairing.agent, lambda: cloud_client(store, configuration, clock)),
        outbox=outbox,
        readings=readings,
        cameras=camera_recorder.create(configuration, journal, pairing, room_devices),
    )
    load = LoadGovernor() if metrics is None else metrics.load
    supervisor = Supervisor()
    devices: dict[str, Device] = {}
    neighbours: dict[str, RoomDriver] = {}
    for entry in configuration.devices:
        room_device = create_room_device(entry, neighbours, uploads, home=store.folder, faults=store.faults)
        if room_device is not None:
            neighbours[entry.name], room_devices[entry.name] = room_device.driver, room_device
        devices[entry.name] = _device(
            entry,
            pairing,
            pins=pins,
            room_device=room_device,
            obstacle_map=(lambda: _obstacle_map(neighbours)) if entry.room else None,
            journal=journal,
            clock=clock,
            transport=transport,
            outbox=outbox,
            readings=readings,
            sandbox=sandbox,
            trace=trace,
            faults=store.faults,
            uploads=uploads,
            load=load,
            supervisor=supervisor,
            traces=traces,
            streaming=configuration.transport != "http",
            recorder=recorder,
        )
    if metrics is not None:
        metrics.read_from(devices, outbox)
    agent = Agent(devices, transport, outbox=outbox, readings=readings, address=(pairing.space, pairing.agent))
    return RunningAgent(agent, journal, monitor, sandbox, supervisor, recorder)


def _own_streams(configuration: AgentConfig) -> Iterator[tuple[str, str]]:
    """Streams of the agent's own room devices, which scripts may read without configuration."""
    for entry in configuration.devices:
        device = room_device_of(entry)
        for stream in () if device is None else device.streams:
            yield entry.name, stream.name


def _obstacle_map(neighbours: Mapping[str, RoomDriver]) -> ObstacleMap | None:
    """The obstacle map of the room, if a perception device of this agent is connected."""
    from device_agent.sensors.perception.driver import PerceptionDriver  # noqa: PLC0415 (needed for navigation only)

    for driver in neighbours.values():
        if isinstance(driver, PerceptionDriver):
            with contextlib.suppress(SensorError):
                return driver.grid
    return None


def _outbox(
    store: IdentityStore, configuration: AgentConfig, pairing: Pairing, *, publish: Publish, quiet: Callable[[], bool]
) -> Outbox:
    own, buffer = f"{topics.ROOT}/{pairing.space}/{pairing.agent}/", configuration.buffer
    limits = {"max_bytes": round(buffer.max_mb * 1e6), "max_age_ms": round(buffer.max_age_h * 3_600_000)}
    kept, topic = OutboxStore(store.outbox, own=own, **limits), own + configuration.devices[0].name
    return Outbox(kept, publish=publish, device_topic=topic, is_quiet=quiet, keep_hz=buffer.measurements_hz)


def _device(
    entry: DeviceEntry,
    pairing: Pairing,
    *,
    pins: PinnedKeys,
    room_device: RoomDevice | None,
    obstacle_map: Callable[[], ObstacleMap | None] | None,
    journal: Journal,
    clock: CloudClock,
    transport: Transport,
    outbox: Outbox,
    readings: ReadingCache,
    sandbox: Sandbox,
    trace: Path | None,
    faults: Path,
    uploads: Uploads,
    load: LoadGovernor,
    supervisor: Supervisor,
    traces: CommandTraces | None,
    streaming: bool,
    recorder: Recorder | None,
) -> Device:
    kind = type_of(entry)
    driver = create_driver(entry, kind, trace=trace, faults=faults) if room_device is None else room_device
    return Device(
        name=entry.name,
        label=entry.label or kind.label,
        space=pairing.space,
        agent=pairing.agent,
        robot_type=kind,
        obstacle_map=obstacle_map,
        driver=driver,
        journal=journal,
        cloud_clock=clock,
        keys=pins,
        publish=transport.publish,
        outbox=outbox,
        readings=readings,
        interlocks=entry.interlocks,
        geometry=load_geometry(entry, kind),
        sandbox=sandbox,
        owner=pairing.owner,
        speech=Espeak(),
        uploads=uploads,
        load=load,
        supervisor=supervisor,
        traces=traces,
        streaming=streaming,
        recorder=recorder,
        task_monitors=None if isinstance(driver, RoomDevice) else TaskMonitors(tasks_of(kind), driver, readings),
    )
