"""Injects the faults of a plan, and ends all of them."""

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.simulation.plan import Step
    from tests.simulation.world import World

_BACKUP_S = 1.0
_RESTART_S = 0.3


class Faults:
    """Injects faults into a world."""

    def __init__(self, world: "World") -> None:
        self._world = world
        self._ended = False
        self.restored = self.clock_jumped = False
        self._backups: list[tuple[float, object]] = []

    @property
    def keys_may_end(self) -> bool:
        """Whether idempotency keys may have been deleted: by a restore, or because they were old."""
        return self.restored or self.clock_jumped

    async def inject(self, step: "Step") -> None:
        """Inject one fault, and end it after its duration."""
        self._world.history.note("fault", str(step))
        await getattr(self, step.kind)(**step.arguments)

    async def end_all(self) -> None:
        """End all faults."""
        world = self._world
        self._ended = True
        world.history.note("fault", "all faults end")
        network = world.network
        for state in (network.blocked, network.slow_s, network.reordered, network.duplicated):
            state.clear()
        world.broker.restart()
        for index, instance in enumerate(world.instances):
            if instance is None:
                world.start_function(index)
            else:
                instance.crash_in = 0
        if world.worker is None or not world.worker.alive:
            world.start_worker()
        else:
            world.worker.crash_in = 0
            world.worker.continue_()
        for machine in world.machines.values():
            machine.disk.full = False
            if machine.process is not None:
                machine.process.crash_in = 0
                self._continue(machine.name)
            for driver in machine.drivers.values():
                driver.broken, driver.slow_s = False, 0.0
            machine.start()

    # ------------------------------------------------------------ processes

    async def kill_function(self, *, index: int, after: int) -> None:
        instance = self._world.instances[index]
        if instance is not None:
            instance.crash_in = after
            await self._world.wait_until(lambda: self._ended or not instance.alive, most_s=60.0)
            await asyncio.sleep(_RESTART_S)
            if self._world.instances[index] is None:
                self._world.start_function(index)

    async def kill_worker(self, *, after: int, for_s: float) -> None:
        worker = self._world.worker
        if worker is not None and worker.alive:
            worker.crash_in = after
            await self._world.wait_until(lambda: self._ended or not worker.alive, most_s=60.0)
            await asyncio.sleep(for_s)
            if self._world.worker is worker:
                self._restart_worker()

    def _restart_worker(self) -> None:
        if self._world.worker is None or not self._world.worker.alive:
            self._world.start_worker()

    async def suspend_worker(self, *, for_s: float) -> None:
        worker = self._world.worker
        if worker is not None:
            worker.suspend()
            await asyncio.sleep(for_s)
            worker.continue_()

    async def kill_broker(self, *, for_s: float) -> None:
        broker = self._world.broker
        if broker.running:
            broker.crash()
            await asyncio.sleep(for_s)
            broker.restart()

    async def kill_agent(self, *, agent: str, after: int) -> None:
        machine = self._world.machines[agent]
        if machine.process is not None and after:
            machine.process.crash_in = after
        else:
            machine.kill()

    async def power_failure(self, *, agent: str) -> None:
        self._world.machines[agent].kill(power=True)

    async def suspend_agent(self, *, agent: str, for_s: float) -> None:
        process = self._world.machines[agent].process
        if process is not None:
            self._world.scheduler.suspend(process)
            await asyncio.sleep(for_s)
            if process.suspended:
                self._continue(agent)

    def _continue(self, agent: str) -> None:
        machine = self._world.machines[agent]
        if machine.process is not None and machine.process.suspended:
            for name in machine.device_names:
                self._world.monitors.robots.resumed(machine.device_id(name))
            self._world.scheduler.continue_(machine.process)

    # ------------------------------------------------------------ network

    async def partition(self, *, pair: tuple[str, str], direction: str, for_s: float) -> None:
        paths = {pair, pair[::-1]} if direction == "both" else {pair} if direction == "to" else {pair[::-1]}
        self._world.network.blocked |= paths
        await asyncio.sleep(for_s)
        self._world.network.blocked -= paths

    async def slow_network(self, *, machine: str, delay_s: float, for_s: float) -> None:
        self._world.network.slow_s[machine] = delay_s
        await asyncio.sleep(for_s)
        self._world.network.slow_s.pop(machine, None)

    async def reorder(self, *, machine: str, for_s: float) -> None:
        self._world.network.reordered.add(machine)
        await asyncio.sleep(for_s)
        self._world.network.reordered.discard(machine)

    async def duplicate(self, *, machine: str, for_s: float) -> None:
        self._world.network.duplicated.add(machine)
        await asyncio.sleep(for_s)
        self._world.network.duplicated.discard(machine)

    # ------------------------------------------------------------ clocks, disks, drivers

    async def cloud_clock(self, *, jump_ms: int) -> None:
        self._world.clocks.cloud_offset_ms += jump_ms
        self.clock_jumped = True

    async def agent_clock(self, *, agent: str, jump_ms: int) -> None:
        machine = self._world.machines[agent]
        machine.set_wall_offset(machine.wall_offset_ms + jump_ms)

    async def full_disk(self, *, agent: str, for_s: float) -> None:
        disk = self._world.machines[agent].disk
        disk.full = True
        await asyncio.sleep(for_s)
        disk.full = False

    async def slow_driver(self, *, agent: str, slow_s: float, for_s: float) -> None:
        machine = self._world.machines[agent]
        for driver in machine.drivers.values():
            driver.slow_s = slow_s
        await asyncio.sleep(for_s)
        for driver in machine.drivers.values():
            driver.slow_s = 0.0

    async def broken_driver(self, *, agent: str, for_s: float) -> None:
        machine = self._world.machines[agent]
        for driver in machine.drivers.values():
            driver.broken = True
        await asyncio.sleep(for_s)
        for driver in machine.drivers.values():
            driver.broken = False

    # ------------------------------------------------------------ backups

    async def restore(self, *, age_s: float) -> None:
        """Take a backup now; after ``age_s``, stop the cloud, restore the backup, and start the cloud."""
        world = self._world
        backup = world.stores.tables.snapshot()
        await asyncio.sleep(age_s)
        if self._ended:
            return
        world.history.note("fault", f"restore of the backup that is {age_s} s old")
        for instance in [*world.instances, world.worker]:
            if instance is not None and instance.alive:
                instance.kill()
        await asyncio.sleep(_RESTART_S)
        world.stores.tables.restore(backup)
        self.restored = True
        world.monitors.rows.restored(world.stores.tables)
        await world.settle_restore()
        for index in range(len(world.instances)):
            world.start_function(index)
        world.start_worker()
