"""A process of the cloud: the real services over shared tables. After a crash, none of its calls continues."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

from function_app import bootstrap
from function_app.adapters.factory import Adapters
from function_app.adapters.local.certificates import NoCertificates
from function_app.adapters.local.password_hasher import Argon2Hashes
from function_app.adapters.local.robot_catalogue import FolderCatalogue
from function_app.entrypoints.hosts.worker import SWEEP_EVERY_S
from function_app.entrypoints.ingest.router import ingest
from function_app.ports.tables import Page, Row, Write
from function_app.settings import RateLimits, Settings
from tests.fakes.blobs import MemoryBlobs
from tests.fakes.broker_ports import MemoryBrokerAccess
from tests.fakes.signing_keys import MemorySigningKeys
from tests.fakes.tables import MemoryTables
from tests.harness.cloud.memory import NO_FOLDER
from tests.harness.paths import ROBOTS
from tests.simulation.engine.patches import Clocks
from tests.simulation.network.broker import Broker
from tests.simulation.network.cloud_connections import NoTelemetry, SimulatedBus, SimulatedFeed

if TYPE_CHECKING:
    from tests.fakes.broker import MemoryBroker

T = TypeVar("T")
Committed = Callable[[str, Sequence[Write]], None]
_catalogue = FolderCatalogue(ROBOTS)
_unlimited = RateLimits(address=0, account=0, key=0, agent=0)
SETTINGS = Settings(home=NO_FOLDER, public_url="http://telescope.test", mqtt_port=1, rate_limits=_unlimited)


class SharedTables(MemoryTables):
    """The tables of all instances; ``committed`` receives each successful write."""

    def __init__(self, committed: Committed) -> None:
        super().__init__()
        self._committed = committed

    async def _apply(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        rows = await super()._apply(table, writes)
        self._committed(table, writes)
        return rows

    def snapshot(self) -> dict[tuple[str, str], dict[str, tuple[str, bytes]]]:
        """A consistent copy, as a backup contains it."""
        return {name: dict(partition.rows) for name, partition in self._partitions.items()}

    def restore(self, snapshot: dict[tuple[str, str], dict[str, tuple[str, bytes]]]) -> None:
        """Replace all rows by those of a backup."""
        self._partitions.clear()
        for (table, name), rows in snapshot.items():
            partition = self.partition(table, name)
            partition.rows = dict(rows)
            partition.keys = sorted(rows)


class Stores:
    """What all instances share."""

    def __init__(self, clocks: Clocks, committed: Committed) -> None:
        self.clocks = clocks
        self.tables = SharedTables(committed)
        self.blobs = MemoryBlobs(now_s=lambda: clocks.now_ms() / 1000)
        self.keys = MemorySigningKeys(now_ms=clocks.now_ms)


class Instance:
    """One process of the functions, or the worker.

    Attributes:
        alive: Whether it runs; the calls of a killed process wait forever.
        crash_in: Number of accesses to tables and broker until it is killed; 0: not planned.
        functions: The real services.
        connections: Its connections to the broker.
    """

    def __init__(
        self, name: str, stores: Stores, broker: Broker, rng: random.Random, *, crashed: Callable[["Instance"], None]
    ) -> None:
        self.name = name
        self.broker = broker
        self.loop: Any = broker.network.loop
        self.alive = True
        self.crash_in = 0
        self._crashed = crashed
        self._rng = rng
        self._running = asyncio.Event()
        self._running.set()
        self._tasks: set[asyncio.Task[Any]] = set()
        access = MemoryBrokerAccess(cast("MemoryBroker", broker))  # it has the attributes that the class uses
        bus, feed = SimulatedBus(self, access), SimulatedFeed(self, access)
        self.connections = (bus, feed)
        adapters = Adapters(
            keys=stores.keys,
            tables=_InstanceTables(stores.tables, self),
            blobs=stores.blobs,
            transfers=stores.blobs,
            access=access,
            bus=bus,
            feed=feed,
            telemetry=NoTelemetry(),
            late=NoTelemetry(),
            certificates=NoCertificates(),
            password_hashes=Argon2Hashes(),
            catalogue=_catalogue,
        )
        self.functions = bootstrap.build(SETTINGS, clock=stores.clocks, adapters=adapters)

    def spawn(self, call: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Run a coroutine of this process."""
        task = self.loop.create_task(call)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task  # type: ignore[no-any-return]

    def start_worker(self) -> None:
        """Ingest messages and run the timer, as ``function_app.entrypoints.hosts.worker`` does."""
        functions = self.functions

        async def handle(topic: str, payload: bytes) -> None:
            await ingest(functions, topic, payload)
            await functions.confirmations.publish([(topic, payload)])

        async def sweep() -> None:
            while True:
                await self.step()
                await functions.scheduler.run_due_jobs()
                await asyncio.sleep(SWEEP_EVERY_S)

        self.spawn(functions.feed.run(handle))
        self.spawn(sweep())

    def kill(self) -> None:
        """End the process now."""
        self.alive = False
        self._crashed(self)

    def suspend(self) -> None:
        """Freeze the process, as SIGSTOP does."""
        self._running.clear()

    def continue_(self) -> None:
        self._running.set()

    async def step(self) -> None:
        """An access to another process: it takes time, and the process may be killed or frozen before it."""
        if self.crash_in:
            self.crash_in -= 1
            if not self.crash_in and self.alive:
                self.kill()
        if not self.alive:
            await self.loop.create_future()
        if not self._running.is_set():
            await self._running.wait()
        if self._rng.random() < 0.3:
            await asyncio.sleep(0.004 * self._rng.random())
            if not self.alive:
                await self.loop.create_future()

    async def end(self) -> None:
        """Cancel what is left after the simulation."""
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


class _InstanceTables:
    """``Tables`` of one process."""

    def __init__(self, tables: SharedTables, instance: Instance) -> None:
        self._tables = tables
        self._instance = instance

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        return await self._call(lambda: self._tables.get(table, partition, key))

    async def create(self, table: str, row: Row) -> Row:
        return await self._call(lambda: self._tables.create(table, row))

    async def replace(self, table: str, row: Row) -> Row:
        return await self._call(lambda: self._tables.replace(table, row))

    async def delete(self, table: str, row: Row) -> None:
        await self._call(lambda: self._tables.delete(table, row))

    async def query(self, table: str, partition: str, **options: Any) -> Page:
        return await self._call(lambda: self._tables.query(table, partition, **options))

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        return await self._call(lambda: self._tables.batch(table, writes))

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        return await self._call(lambda: self._tables.check(thorough=thorough))

    def left_bytes(self) -> int | None:
        return self._tables.left_bytes()

    async def close(self) -> None:
        """Nothing is open."""

    async def _call(self, call: Callable[[], Awaitable[T]]) -> T:
        await self._instance.step()
        result = await call()
        await self._instance.step()
        return result
