"""Instances of the functions in processes of their own, for tests: released together, and killed at any step.

A step is a write to the tables or a message to a device: what a stop of the process can fall between.
"""

import asyncio
import contextlib
import itertools
import json
import multiprocessing
import os
import signal
from collections import defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
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
from function_app.domain.devices.devices import DeviceSpec
from function_app.ports.tables import Page, Row, Tables, Write
from function_app.services.pairing.enroll import Enrollment
from function_app.settings import read

PATIENCE_S = 120.0
T = TypeVar("T")

PROCESSES = multiprocessing.get_context("forkserver")
"""A process that has imported everything and nothing else makes the others: eight of them are there at once."""
PROCESSES.set_forkserver_preload(["tests.harness.processes", "azure.data.tables.aio", "boto3"])


class SetClock:
    """A clock that stands where it is put."""

    def __init__(self, now_ms: int) -> None:
        self._now_ms = now_ms

    def now_ms(self) -> int:
        return self._now_ms

    def advance(self, seconds: float) -> None:
        self._now_ms += round(1000 * seconds)


@dataclass(frozen=True)
class Place:
    """Where an instance works, and when."""

    environment: Mapping[str, str]
    now_ms: int
    sent: Path
    """Every message that any instance sent to a device, a line each."""

    def later(self, seconds: float) -> "Place":
        return replace(self, now_ms=self.now_ms + round(1000 * seconds))


class Death:
    """Ends this process, as ``kill -9`` does, instead of step number ``at`` (counted from 0)."""

    def __init__(self, at: int | None) -> None:
        self._at = at
        self._steps = itertools.count()

    def step(self) -> None:
        if self._at is not None and next(self._steps) >= self._at:
            os.kill(os.getpid(), signal.SIGKILL)


class NotingBus:
    """A broker that accepts every connection and never responds."""

    def __init__(self, sent: Path, death: Death) -> None:
        self._sent = sent
        self._death = death

    async def start(self) -> None:
        pass

    async def publish(self, topic: str, payload: bytes, **_: Any) -> None:
        self._death.step()
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


class MortalTables:
    """Tables, of a process that ends at one of its writes."""

    def __init__(self, inner: Tables, death: Death) -> None:
        self.inner = inner
        self._death = death

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        return await self.inner.get(table, partition, key)

    async def query(self, *arguments: Any, **options: Any) -> Page:
        return await self.inner.query(*arguments, **options)

    async def create(self, table: str, row: Row) -> Row:
        self._death.step()
        return await self.inner.create(table, row)

    async def replace(self, table: str, row: Row) -> Row:
        self._death.step()
        return await self.inner.replace(table, row)

    async def delete(self, table: str, row: Row) -> None:
        self._death.step()
        await self.inner.delete(table, row)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        self._death.step()
        return await self.inner.batch(table, writes)

    async def close(self) -> None:
        await self.inner.close()


def open_functions(place: Place, *, dies_at: int | None = None, clock: SetClock | None = None) -> Functions:
    """An instance over the real store, whose messages to devices are recorded in a file."""
    death = Death(dies_at)
    settings, now = read(place.environment), clock or SetClock(place.now_ms)
    adapters = factory.adapters(settings, now)
    bus = NotingBus(place.sent, death)
    return bootstrap.build(
        settings,
        clock=now,
        adapters=replace(
            adapters,
            tables=MortalTables(adapters.tables, death),
            bus=bus,
            access=TokenBrokerAccess(signer=adapters.keys.signer, publish=bus.publish),
        ),
    )


def run_here(place: Place, work: Callable[[Functions], Awaitable[T]]) -> T:
    """Do something with an instance in this process."""

    async def whole() -> T:
        functions = open_functions(place)
        try:
            return await work(functions)
        finally:
            await functions.close()

    return asyncio.run(whole())


Work = Callable[..., Awaitable[object]]


def _in_child(place: Place, work: Work, arguments: tuple[Any, ...], dies_at: int | None) -> None:
    os.environ.update(place.environment)

    async def whole() -> None:
        functions = open_functions(place, dies_at=dies_at)
        await work(functions, *arguments)
        await functions.close()

    asyncio.run(whole())


def begin(place: Place, work: Work, *arguments: Any, dies_at: int | None = None) -> Any:
    """Do ``work`` (a function of a module) in a process of its own; gives the process."""
    process = PROCESSES.Process(target=_in_child, args=(place, work, arguments, dies_at))
    process.start()
    return process


def killed(process: Any) -> bool:
    """Whether the process, once it has ended, was killed; anything else but a good end fails."""
    process.join(PATIENCE_S)
    assert process.exitcode in {0, -signal.SIGKILL}, f"exit code {process.exitcode}"
    return bool(process.exitcode)


async def show_code(functions: Functions, names: Sequence[str] = ("arm",), *, public: str = "") -> tuple[str, str]:
    """An agent with these devices (and this or a new public key) makes itself known: its id, and its claim code."""
    public = public or new_public_key()
    agent = agent_id(signing.key_id(signing.public_key(public)))
    specs = tuple(DeviceSpec(name, "arm", "ur5", name) for name in names)
    return agent, (await functions.enroll.enroll(agent, Enrollment("lab", public, "1", specs))).claim_code


def new_public_key() -> str:
    return signing.public_text(signing.generate().public_key())


def commands_sent(place: Place) -> dict[str, set[bytes]]:
    """Every signed command that any instance sent, by its id, with all the bytes that it was sent as."""
    found: dict[str, set[bytes]] = defaultdict(set)
    if place.sent.exists():
        for line in place.sent.read_text().splitlines():
            topic, payload = json.loads(line)
            if topic.endswith(f"/{topics.CMD}"):
                envelope = payload.encode("latin-1")
                command = codec.decode(bytes(codec.decode(envelope, signing.Signed).body), Command)
                found[command.id].add(envelope)
    return found
