"""One simulated installation: cloud, broker, network, agents and people, driven by one plan."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from device_agent.config.identity_store import Pairing
from device_agent.protocol import MoveJoints, topics
from device_agent.protocol.security import signing
from function_app.domain.actions.action import Status
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent as AgentRow
from function_app.domain.identity.accounts import Role
from function_app.services.actions.requests import ActionRequest
from function_app.services.storage import records
from tests.fakes.clock import MemoryClock
from tests.fakes.event_loop import VirtualTimeLoop
from tests.simulation.actors.agent import AgentMachine
from tests.simulation.actors.driver import JOINT
from tests.simulation.actors.faults import Faults
from tests.simulation.actors.instance import Instance, Stores
from tests.simulation.actors.people import Person
from tests.simulation.checks import settled
from tests.simulation.checks.history import History
from tests.simulation.checks.monitors import Monitors
from tests.simulation.engine.patches import Clocks, simulated
from tests.simulation.engine.scheduler import Scheduler
from tests.simulation.network.broker import Broker, Link
from tests.simulation.network.wires import CLOUD, Network
from tests.simulation.plan import AGENTS, DURATION_S, PEOPLE, Step

if TYPE_CHECKING:
    from types import SimpleNamespace

    from function_app.bootstrap import Functions

T = TypeVar("T")
HTTP_S = 10.0
SETTLE_S = 60.0
"""Most time until every action has ended after the last fault [s]."""
QUIET_S = 6.0
"""Time without faults before the checks: longer than every lease [s]."""


class World:
    """See the module."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._rngs: dict[str, random.Random] = {}
        self.loop = VirtualTimeLoop(MemoryClock())
        self.loop.set_exception_handler(self._failed)
        self.history = History(self.loop.time)
        self.scheduler = Scheduler(
            self.loop, self.rng("threads"), crashed=lambda process, error: self._thread_crashed(process.name, error)
        )
        self.clocks = Clocks(self.scheduler)
        self.network = Network(self.loop, self.rng("network"))
        self._tasks: set[asyncio.Task[Any]] = set()
        self._number = 0
        self.open_links: list[Link] = []
        self.instances: list[Instance | None] = [None, None]
        self.worker: Instance | None = None
        self._waiting: dict[Instance, list[asyncio.Future[Any]]] = {}
        self._all_instances: list[Instance] = []
        self.people: dict[str, Person] = {}
        self.machines: dict[str, AgentMachine] = {}
        self.devices: list[str] = []
        self._spaces: dict[str, str] = {}
        self.modules: SimpleNamespace
        self.monitors: Monitors
        self.broker: Broker
        self.stores: Stores
        self.faults: Faults

    # ------------------------------------------------------------ the run

    def run(self, steps: Sequence[Step]) -> History:
        """Run a plan to its end. Returns its history."""
        try:
            with simulated(self.scheduler, self.clocks, self.rng("random")) as modules:
                self.modules = modules
                self.monitors = Monitors(self)
                self.broker = Broker(self.network, now_s=lambda: self.clocks.now_ms() / 1000)
                self.broker.routed = self.monitors.routed
                self.stores = Stores(self.clocks, self.monitors.rows.committed)
                self.faults = Faults(self)
                with self.monitors.robots.observing():
                    self.loop.run_until_complete(self._main(steps))
                    self.scheduler.end()
                    self.loop.end()
        finally:
            if not self.loop.is_closed():
                self.loop.close()
        return self.history

    async def _main(self, steps: Sequence[Step]) -> None:
        await self._set_up()
        start_s = self.loop.time()
        self.history.note("plan", f"seed {self.seed}")
        self.scheduler.interrupt_threads(self.rng("threads").choice((40, 200, 5000)))
        for step in steps:
            await asyncio.sleep(max(0.0, start_s + step.at_s - self.loop.time()))
            if step.who:
                self.spawn(self.people[step.who].perform(step))
            else:
                self.spawn(self.faults.inject(step))
        await asyncio.sleep(max(0.0, start_s + DURATION_S - self.loop.time()))
        await self.faults.end_all()
        await self.wait_until(lambda: not self._tasks, most_s=SETTLE_S)
        await self._settle()
        settled.check(self.history, self.monitors.rows, self.monitors.robots)
        for device in self.devices:
            await self._probe(device)
        self.monitors.check_operations()

    async def _set_up(self) -> None:
        for index in range(len(self.instances)):
            self.start_function(index)
        self.start_worker()
        functions = self._function().functions
        for name in PEOPLE:
            self.people[name] = Person(self, name)
            await self.people[name].sign_in(functions)
        anna, bert, carl = self.people.values()
        for name, owner, devices in ((AGENTS[0], anna, ("arm", "leg")), (AGENTS[1], bert, ("arm",))):
            machine = self.machines[name] = AgentMachine(self, name, devices)
            self.devices += [machine.device_id(device) for device in devices]
            await self.pair(machine, owner)
        for device in self.devices[:2]:
            target = await functions.sharing.of(anna.identity, "device", device)
            await functions.sharing.put(anna.identity, target, carl.account, Role.OPERATOR, None)
        await asyncio.sleep(1.0)

    async def pair(self, machine: AgentMachine, owner: Person) -> None:
        """Enroll an agent, claim it, and start its process. The agent enrolls once it knows that it was unpaired."""
        for _ in range(40):
            if machine.pairing is not None:
                await asyncio.sleep(0.5)
                continue
            try:
                claimed = await self._claim(machine, owner)
            except (OSError, Problem):
                await asyncio.sleep(1.0)
                continue
            public = (await self.stores.keys.for_devices()).public_key()
            machine.pairing = Pairing(
                agent=machine.id,
                space=claimed.space or "",
                account=owner.name,
                owner=owner.account.id,
                keys={signing.key_id(public): signing.public_text(public)},
            )
            self._spaces[machine.id] = claimed.space or ""
            self.history.note(machine.name, "paired")
            machine.start()
            return

    async def _claim(self, machine: AgentMachine, owner: Person) -> AgentRow:
        enrolled = await self.call(
            machine.name, lambda functions: functions.enroll.enroll(machine.id, machine.enrollment)
        )
        if enrolled.claimed:
            return enrolled
        code = enrolled.claim_code
        return await self.call(owner.name, lambda functions: functions.claim.claim(owner.identity, code, None))

    async def _settle(self) -> None:
        """Wait until every action has ended, at most ``SETTLE_S``."""
        await asyncio.sleep(QUIET_S)
        actions = self.monitors.rows.actions
        await self.wait_until(lambda: all(fact.status.terminal for fact in actions.values()), most_s=SETTLE_S)
        await asyncio.sleep(1.0)

    async def _probe(self, device: str) -> None:
        """The first commands of the owner must succeed: reset Stop if it is latched, take control, move."""
        owner, machine = self.owner_of(device), self.machine_of(device)
        if machine.pairing is None or (self.faults.restored and not await self._may_operate(owner, device)):
            return  # unpaired, or paired after the backup
        if self.monitors.robots.models[device].latched:
            operation = self.history.invoke(owner.name, "probe-reset", device)
            confirmed = await owner.request(
                operation,
                lambda functions: functions.stop.reset(owner.identity, device),
                lambda each: {"confirmed": each},
            )
            if not confirmed:
                self.history.violate("blocked (reset)", f"{device}: Stop could not be reset")
                return
        await owner.acquire(device, lease_ms=20_000, over="check")
        if not self.history.operations[-1].result.get("confirmed"):
            self.history.violate("blocked (lease)", f"{device}: control could not be taken")
            return
        move = MoveJoints(position_rad={JOINT: 0.1}, speed=1.0)
        request = ActionRequest(request=move, epoch=owner.epochs[device], wait_ms=9000, wait_for="done")
        operation = self.history.invoke(owner.name, "probe", device)
        started = await owner.request(
            operation, lambda functions: functions.start_action.start(owner.identity, device, request)
        )
        if started is None or started[0].status is not Status.DONE:
            code = operation.outcome if started is None else (started[0].reason or {}).get("code", "")
            self.history.violate(f"blocked ({code})", f"{device}: the first action after all faults did not succeed")

    async def _may_operate(self, owner: Person, device: str) -> bool:
        def find(functions: "Functions") -> Awaitable[Any]:
            return functions.devices.find_with_link(owner.identity, device)

        found, _ = await self.call(owner.name, find)
        return found is not None

    # ------------------------------------------------------------ processes of the cloud

    def start_function(self, index: int) -> None:
        """Start a process of the functions."""
        self.instances[index] = self._start(f"function{index}")

    def start_worker(self) -> None:
        """Start the worker."""
        self.worker = self._start("worker")
        self.worker.start_worker()

    async def settle_restore(self) -> None:
        """Prepare restored tables, as ``telescope-server restore`` does before the server starts."""
        command = self._start("restore")
        agents = sorted({row.partition for _, row in self.stores.tables.rows(records.AGENTS)})
        await command.spawn(command.functions.restored_backup.settle(created_ms=0, agents=agents))
        command.kill()

    def _start(self, name: str) -> Instance:
        instance = Instance(name, self.stores, self.broker, self.rng(name), crashed=self._crashed)
        self._all_instances.append(instance)
        self._waiting[instance] = []
        return instance

    def _crashed(self, instance: Instance) -> None:
        self.history.note(instance.name, "killed")
        for connection in instance.connections:
            connection.killed()
        for future in self._waiting.pop(instance):
            if not future.done():
                future.set_exception(ConnectionResetError("the process ended"))
        if instance in self.instances:
            self.instances[self.instances.index(instance)] = None

    def _function(self) -> Instance:
        running = [instance for instance in self.instances if instance is not None]
        if not running:
            raise ConnectionRefusedError("no process listens")
        return self.rng("balancer").choice(running)

    async def call(self, source: str, request: Callable[["Functions"], Awaitable[T]]) -> T:
        """Send an HTTP request from a machine. Raises ``OSError`` if no response arrives, and ``Problem``."""
        if not await self.network.transfer(source, CLOUD, within_s=HTTP_S):
            raise TimeoutError("no connection")
        instance = self._function()
        response: asyncio.Future[T] = self.loop.create_future()
        self._waiting[instance].append(response)
        task = instance.spawn(_awaited(request(instance.functions)))

        def done(task: asyncio.Task[T]) -> None:
            error = None if task.cancelled() else task.exception()
            if response.done() or task.cancelled():
                return
            if error is None:
                response.set_result(task.result())
            else:
                response.set_exception(error)

        task.add_done_callback(done)
        problem: Problem | None = None
        try:
            async with asyncio.timeout(HTTP_S):
                result = await response
        except Problem as rejected:
            problem = rejected
        if not await self.network.transfer(CLOUD, source, within_s=HTTP_S):
            raise TimeoutError("no response")
        if problem is not None:
            raise problem
        return result

    # ------------------------------------------------------------ helpers

    def rng(self, name: str) -> random.Random:
        """Random numbers of one component."""
        if name not in self._rngs:
            self._rngs[name] = random.Random(f"{self.seed} {name}")
        return self._rngs[name]

    async def wait_until(self, condition: Callable[[], bool], *, most_s: float) -> None:
        """Wait until a condition holds, or a virtual time has passed."""
        end_s = self.loop.time() + most_s
        while not condition() and self.loop.time() < end_s:  # noqa: ASYNC110 (polling costs nothing in virtual time)
            await asyncio.sleep(0.2)

    def next_number(self) -> int:
        self._number += 1
        return self._number

    def spawn(self, call: Coroutine[Any, Any, Any]) -> None:
        """Run a coroutine in the background."""
        task = self.loop.create_task(call)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(self._raise)

    def _raise(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self.history.violate("error", f"{type(error).__name__}: {error}")

    def _failed(self, _loop: object, context: dict[str, Any]) -> None:
        if not self.scheduler.ended:
            self.history.violate("error", f"{context['message']}: {context.get('exception')!r}")

    def _thread_crashed(self, machine: str, error: str) -> None:
        if self.machines[machine].pairing is not None:  # otherwise the process is about to end
            self.history.violate("thread-crashed", f"{machine}: {error}")

    def sockets_closed(self, machine: str) -> None:
        """The processes of a machine ended: its connections are reset."""
        self.broker.reset(machine)

    def machine_of(self, device: str) -> AgentMachine:
        return next(machine for machine in self.machines.values() if device.startswith(machine.id))

    def owner_of(self, device: str) -> Person:
        return self.people["anna" if self.machine_of(device).name == AGENTS[0] else "bert"]

    def topic(self, device: str, kind: str, name: str = "") -> str:
        agent, _, device_name = device.partition("-")
        return topics.device(self._spaces[agent], agent, device_name, kind, name)

    def telemetry_topic(self, device: str) -> str:
        return self.topic(device, topics.TELE, topics.ANY)


async def _awaited(call: Awaitable[T]) -> T:
    return await call
