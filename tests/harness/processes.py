"""Instances of the functions in processes of their own that start together or are killed at any step.

A step is a write to the tables or a message to a device.
"""

import asyncio
import contextlib
import json
import multiprocessing
import os
import queue
import signal
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from device_agent.protocol import Command, codec, topics
from device_agent.protocol.security import signing
from function_app import bootstrap
from function_app.adapters import factory
from function_app.adapters.local.broker_access import TokenBrokerAccess
from function_app.bootstrap import Functions
from function_app.domain.common.ids import agent_id
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import DeviceSpec
from function_app.domain.identity.accounts import Identity
from function_app.services.pairing.enroll import Enrollment
from function_app.settings import read
from tests.fakes.event_loop import VirtualTimeLoop
from tests.harness.cloud.memory import Memory
from tests.harness.crash_injection import Killed, KillPoint, crashing_tables

PATIENCE_S = 120.0
T = TypeVar("T")

PROCESSES = multiprocessing.get_context("forkserver")
"""The processes are forked from one that has imported all modules."""
PROCESSES.set_forkserver_preload(["tests.harness.processes", "azure.data.tables.aio", "boto3"])


class SetClock:
    """A clock that a test sets."""

    def __init__(self, now_ms: int) -> None:
        self._now_ms = now_ms

    def now_ms(self) -> int:
        return self._now_ms

    def advance(self, seconds: float) -> None:
        self._now_ms += round(1000 * seconds)


@dataclass(frozen=True)
class Place:
    """Store, time and message log of the instances of one test.

    Attributes:
        environment: Settings that select the store.
        now_ms: Time at which instances start.
        sent: File with every message that an instance sent to a device, one per line.
        memory: The store if it is in memory; then processes and their end are simulated.
    """

    environment: Mapping[str, str]
    now_ms: int
    sent: Path
    memory: Memory | None = None

    def later(self, seconds: float) -> "Place":
        return replace(self, now_ms=self.now_ms + round(1000 * seconds))


class RecordingBus:
    """A broker that accepts every connection and never responds."""

    def __init__(self, sent: Path, kill_point: KillPoint) -> None:
        self._sent = sent
        self._kill_point = kill_point

    async def start(self) -> None:
        pass

    async def publish(self, topic: str, payload: bytes, **_: Any) -> None:
        self._kill_point.step()
        line = json.dumps([topic, payload.decode("latin-1")]) + "\n"
        file = os.open(self._sent, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        os.write(file, line.encode())
        os.close(file)

    @contextlib.asynccontextmanager
    async def acks(self, device_topic: str, command: str) -> AsyncIterator[None]:
        del device_topic, command
        yield None

    async def status(self) -> str:
        return "ok"

    async def close(self) -> None:
        pass


def open_functions(place: Place, kill_point: KillPoint | None = None) -> Functions:
    """An instance over this store, whose messages to devices are recorded in a file."""
    kill_point = kill_point or KillPoint(None)
    settings, clock = read(place.environment), SetClock(place.now_ms)
    adapters = factory.adapters(settings, clock) if place.memory is None else place.memory.adapters(settings)
    bus = RecordingBus(place.sent, kill_point)
    return bootstrap.build(
        settings,
        clock=clock,
        adapters=replace(
            adapters,
            tables=crashing_tables(adapters.tables, kill_point),
            bus=bus,
            access=TokenBrokerAccess(signer=adapters.keys.signer, publish=bus.publish),
        ),
    )


def run_here(place: Place, work: Callable[[Functions], Awaitable[T]], kill_point: KillPoint | None = None) -> T:
    """Use an instance in this process."""

    async def whole() -> T:
        functions = open_functions(place, kill_point)
        try:
            return await work(functions)
        finally:
            await functions.close()

    if place.memory is None:
        return asyncio.run(whole())
    loop = VirtualTimeLoop(place.memory.clock)
    try:
        return loop.complete(whole())
    finally:
        loop.end()


Work = Callable[..., Awaitable[object]]


def _in_child(place: Place, work: Work, arguments: tuple[Any, ...], kill_at: int | None) -> None:
    os.environ.update(place.environment)
    run_here(place, lambda functions: work(functions, *arguments), KillPoint(kill_at))


def begin(place: Place, work: Work, *arguments: Any, kill_at: int | None = None) -> Any:
    """Do ``work`` (a function of a module) in a process of its own; returns the process."""
    process = PROCESSES.Process(target=_in_child, args=(place, work, arguments, kill_at))
    process.start()
    return process


def killed(process: Any) -> bool:
    """Wait for the end of a process. Returns True if it was killed; another exit code fails."""
    process.join(PATIENCE_S)
    assert process.exitcode in {0, -signal.SIGKILL}, f"exit code {process.exitcode}"
    return bool(process.exitcode)


def kill(place: Place, work: Work, *arguments: Any, at: int) -> bool:
    """Do ``work`` in a process that is killed instead of its step ``at``. Returns False if it ends before."""
    if place.memory is None:
        return killed(begin(place, work, *arguments, kill_at=at))
    kill_point = KillPoint(at, simulated=True)
    with contextlib.suppress(Killed):
        run_here(place, lambda functions: work(functions, *arguments), kill_point)
    return kill_point.reached


Attempts = Callable[[Functions, Any, Any], Iterable[Callable[[], Awaitable[object]]]]


def race(place: Place, attempts: Attempts, shared: Any, racers: Sequence[Any]) -> dict[Any, list[str]]:
    """Let processes, one per racer, make their attempts in step with each other.

    Args:
        place: The common store.
        attempts: A function of a module that returns the attempts of one racer.
        shared: Passed to ``attempts``, with the racer.
        racers: Passed one to each process.

    Returns:
        Racer → the outcome of each attempt: ``done``, or the code of the problem.
    """
    barrier, results = PROCESSES.Barrier(len(racers)), PROCESSES.Queue()
    processes = [begin(place, _attempt, attempts, shared, racer, (barrier, results)) for racer in racers]
    found: dict[Any, list[str]] = {}
    while len(found) < len(racers):
        with contextlib.suppress(queue.Empty):
            racer, outcomes = results.get(timeout=1)
            found[racer] = outcomes
        assert not any(process.exitcode for process in processes), "a process failed: its traceback is above"
    for process in processes:
        assert not killed(process)
    return found


async def _attempt(
    functions: Functions, attempts: Attempts, shared: Any, racer: Any, channels: tuple[Any, Any]
) -> None:
    barrier, results = channels
    outcomes = []
    for attempt in attempts(functions, shared, racer):
        barrier.wait(PATIENCE_S)
        try:
            await attempt()
        except Problem as problem:
            outcomes.append(problem.code)
        else:
            outcomes.append("done")
    results.put((racer, outcomes))


async def claimed_devices(functions: Functions, owner: Identity, count: int) -> list[str]:
    """Ids of this number of devices of the owner, up to 20 behind each agent."""
    devices: list[str] = []
    while len(devices) < count:
        names = [f"d{number}" for number in range(min(20, count - len(devices)))]
        agent, code = await show_code(functions, names)
        await functions.claim.claim(owner, code, None)
        devices += [f"{agent}-{name}" for name in names]
    return devices


async def show_code(functions: Functions, names: Sequence[str] = ("arm",), *, public: str = "") -> tuple[str, str]:
    """Enroll an agent with these devices and this or a new public key; returns its id and its claim code."""
    public = public or new_public_key()
    agent = agent_id(signing.key_id(signing.public_key(public)))
    specs = tuple(DeviceSpec(name, "arm", "ur5", name) for name in names)
    return agent, (await functions.enroll.enroll(agent, Enrollment("lab", public, "1", specs))).claim_code


def new_public_key() -> str:
    return signing.public_text(signing.generate().public_key())


def commands_sent(place: Place) -> dict[str, set[bytes]]:
    """Command id → all payloads with which an instance sent it."""
    found: dict[str, set[bytes]] = defaultdict(set)
    if place.sent.exists():
        for line in place.sent.read_text().splitlines():
            topic, payload = json.loads(line)
            if topic.endswith(f"/{topics.CMD}"):
                envelope = payload.encode("latin-1")
                command = codec.decode(bytes(codec.decode(envelope, signing.Signed).body), Command)
                found[command.id].add(envelope)
    return found
