"""The machine of an agent and its process: the real runtime over a simulated disk, network and driver."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from device_agent.config.identity_store import Pairing
from device_agent.ports.clock import CloudClock, tick_ms, wall_ms
from device_agent.protocol.security import signing
from device_agent.runtime.agent import Agent
from device_agent.runtime.commands.pinned_keys import PinnedKeys
from device_agent.runtime.device import Device
from device_agent.runtime.readings import ReadingCache
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.storage.outbox_store import OutboxStore
from device_agent.runtime.telemetry.outbox import Outbox
from function_app.domain.common.ids import agent_id
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent as AgentRow
from function_app.domain.devices.devices import DeviceSpec
from function_app.ports.broker_access import Credentials
from function_app.services.pairing.enroll import Enrollment
from function_app.services.storage import records
from tests.fakes.drivers import joint, robot_type
from tests.harness.agent.sandbox import NoSandbox
from tests.simulation.actors.driver import JOINT, KinematicDriver
from tests.simulation.engine.disk import Disk
from tests.simulation.engine.scheduler import Process
from tests.simulation.network.agent_transport import SimulatedTransport

if TYPE_CHECKING:
    from function_app.bootstrap import Functions
    from tests.simulation.world import World

PERIOD_MS = 60
CLOCK_PERIOD_S = 5.0
"""Period of HTTP exchanges; those of the latency reports are rarer [s]."""
RESTART_S = 1.0
TYPE = robot_type(joints=[joint(JOINT)], period_ms=PERIOD_MS)


class BrokerTicket(NamedTuple):
    """What an agent needs to connect."""

    space: str
    client_id: str
    credentials: Credentials
    subscribe: tuple[str, ...]
    confirmations: str


class AgentMachine:
    """One machine with an agent. The disk, the keys and the pairing survive the process.

    Attributes:
        process: The running process; ``None`` while it is not running.
        clock_error_ms: Upper bound of the error of the agent's estimate of the cloud's clock [ms].
    """

    def __init__(self, world: "World", name: str, devices: tuple[str, ...]) -> None:
        self.world = world
        self.name = name
        self.device_names = devices
        self.key = signing.generate()
        self.id = agent_id(signing.key_id(self.key.public_key()))
        self.disk = Disk()
        self.pairing: Pairing | None = None
        self.process: Process | None = None
        self.wall_offset_ms = 0
        self.monotonic_offset_s = world.rng("machine").uniform(10.0, 1e6)
        self.drivers: dict[str, KinematicDriver] = {}
        self.positions_rad = dict.fromkeys(devices, 0.0)
        self.agent: Agent | None = None
        self.clock_error_ms = 0.0

    def device_id(self, name: str) -> str:
        return f"{self.id}-{name}"

    @property
    def enrollment(self) -> Enrollment:
        devices = tuple(DeviceSpec(name, "arm", "test", name) for name in self.device_names)
        return Enrollment(self.name, signing.public_text(self.key.public_key()), "simulated", devices)

    # ------------------------------------------------------------ process

    def start(self) -> None:
        """Start the process, unless it runs or the agent is not paired."""
        if self.process is not None or self.pairing is None:
            return
        process = self.process = Process(
            self.name, self.disk, wall_offset_ms=self.wall_offset_ms, monotonic_offset_s=self.monotonic_offset_s
        )
        process.on_crash = self.kill
        self.world.history.note(self.name, "agent starts")
        self.world.scheduler.start(process, self._main)

    def kill(self, *, power: bool = False) -> None:
        """End the process now; with ``power``, the machine as well."""
        process, self.process = self.process, None
        if process is None:
            return
        process.alive = False
        self.agent = None
        self.world.history.note(self.name, "power failure" if power else "agent killed")
        self.world.monitors.agent_killed(self)
        if power:
            self.disk.lose_power(self.world.rng("disk"))
            self.monotonic_offset_s = self.world.rng("machine").uniform(10.0, 1e3) - self.world.loop.time()
        else:
            self.disk.process_killed()
        self.world.sockets_closed(self.name)
        self.world.loop.call_later(RESTART_S, self.start)

    def set_wall_offset(self, offset_ms: int) -> None:
        """Set the machine's wall clock."""
        self.wall_offset_ms = offset_ms
        if self.process is not None:
            self.process.wall_offset_ms = offset_ms

    def unpaired(self) -> None:
        """Stop the agent: the cloud reports that its pairing has ended. The supervisor starts a new enrolment."""
        self.pairing = None

    def _main(self) -> None:
        """The main thread. An error ends the process, and the service manager starts it again."""
        try:
            self._run_agent()
        except JournalError as error:
            self.world.history.note(self.name, f"agent exits: {error}")
            self.kill()

    def _run_agent(self) -> None:
        """Build and start the agent, as ``device_agent.bootstrap`` does; stop it when it was unpaired."""
        pairing = self.pairing
        assert pairing is not None
        clock = CloudClock()
        folder = Path("/agent")
        journal = Journal(folder / "journal.db")
        journal.open(now_ms=wall_ms())
        journal.end_open(now_ms=wall_ms(), tick_ms=tick_ms())
        keys = PinnedKeys(pairing, identity=self.key, save=lambda _: None, now_ms=clock.now_ms)
        readings = ReadingCache(space=pairing.space, agent=self.id, own=self.device_names)
        self._clock = clock
        transport = SimulatedTransport(self, journal.next_session)
        own = f"ts/v1/{pairing.space}/{self.id}/"
        outbox = Outbox(
            OutboxStore(folder / "outbox.db", own=own, max_bytes=10**6, max_age_ms=3_600_000),
            publish=transport.publish,
            device_topic=own + self.device_names[0],
            is_quiet=lambda: agent.quiet,
        )
        parts = {
            "journal": journal,
            "cloud_clock": clock,
            "keys": keys,
            "publish": transport.publish,
            "outbox": outbox,
            "readings": readings,
        }
        devices = {name: self._device(name, pairing, **parts) for name in self.device_names}
        agent = Agent(devices, transport, outbox=outbox, readings=readings, address=(pairing.space, self.id))
        self.world.monitors.agent_built(self, devices)
        agent.start()
        self.agent = agent
        while self.pairing is pairing:
            self.world.scheduler.block(None, CLOCK_PERIOD_S)
            self._exchange()
        agent.stop()
        journal.close()
        process, self.process, self.agent = self.process, None, None
        if process is not None:
            process.alive = False
        self.world.monitors.agent_killed(self)
        self.world.loop.call_soon(self.start)

    def _device(self, name: str, pairing: Pairing, **parts: Any) -> Device:
        scheduler = self.world.scheduler

        def sent(position_rad: float) -> None:
            self.positions_rad[name] = position_rad

        driver = KinematicDriver(self.positions_rad[name], sent, lambda seconds: scheduler.block(None, seconds))
        self.drivers[name] = driver
        return Device(
            name=name,
            label=name,
            space=pairing.space,
            agent=self.id,
            robot_type=TYPE,
            driver=driver,
            sandbox=NoSandbox(),
            owner=pairing.owner,
            **parts,
        )

    # ------------------------------------------------------------ HTTP, in a thread of the process

    def request_credentials(self) -> BrokerTicket | None:
        """Broker credentials; ``None`` if the agent was unpaired. Raises ``OSError``."""
        pairing = self.pairing

        async def request(functions: "Functions") -> BrokerTicket | None:
            _, row = await records.find(functions.tables, records.AGENTS, self.id, "agent", AgentRow)
            if row is None or not row.claimed or pairing is None or row.space != pairing.space:
                return None
            issued = await functions.mqtt_credentials.agent(row)
            assert issued.confirmations is not None
            return BrokerTicket(row.space, issued.client_id, issued.credentials, issued.subscribe, issued.confirmations)

        ticket: BrokerTicket | None = self._http(request)
        if ticket is None and self.pairing is pairing:  # not paired again while the response was on its way
            self.unpaired()
        return ticket

    def _exchange(self) -> None:
        """Any HTTP exchange: it updates the estimate of the cloud's clock."""

        async def nothing(_: "Functions") -> bool:
            return True

        try:
            self._http(nothing)
        except OSError:
            return

    def _http(self, call: Callable[["Functions"], Awaitable[Any]]) -> Any:
        world = self.world
        waiting: list[Any] = []
        results: list[Any] = []

        async def request() -> None:
            try:
                result = await world.call(self.name, lambda functions: _timed(functions, call))
            except (OSError, Problem) as error:
                results.append(OSError(str(error)))
            else:
                results.append(result)
            world.scheduler.wake(waiting)

        sent_ms = tick_ms()
        world.spawn(request())
        world.scheduler.block(waiting, None)
        result = results[0]
        if isinstance(result, OSError):
            raise result
        value, server_ms = result
        self._clock.observe(server_ms=server_ms, sent_tick_ms=sent_ms, received_tick_ms=tick_ms())
        self.clock_error_ms = max(self.clock_error_ms, (tick_ms() - sent_ms) / 2)
        return value


async def _timed(functions: "Functions", call: Callable[["Functions"], Awaitable[Any]]) -> tuple[Any, int]:
    """The result of a request, and the server's time in its response."""
    result = await call(functions)
    return result, functions.clock.now_ms()
