"""Runs all simulated processes in one thread: coroutines of the cloud, and threads of agents as greenlets.

The event loop with virtual time decides the order. A thread of an agent runs until it blocks. The threads of a killed
process never continue.
"""

import random
import traceback
from collections.abc import Callable
from typing import Any

from greenlet import GreenletExit, getcurrent, greenlet

from tests.fakes.event_loop import VirtualTimeLoop

EPOCH_MS = 1_800_000_000_000
"""Wall clock at the start of each simulation [ms since 1970]."""


SHORTEST_S = 1e-5
"""Shortest time that a thread sleeps; the clocks of machines resolve it [s]."""


class Killed(BaseException):
    """Ends a thread of a killed process after the simulation."""


class Process:
    """A process of an agent, from its start until it is killed.

    Attributes:
        name: Name of its machine.
        alive: Whether its threads continue.
        wall_offset_ms: Error of the machine's wall clock [ms].
        monotonic_offset_s: The machine's monotonic clock minus the virtual time [s].
        disk: The machine's disk.
        crash_in: Number of disk accesses until the process is killed; 0: not planned.
    """

    def __init__(self, name: str, disk: Any, *, wall_offset_ms: int = 0, monotonic_offset_s: float = 0.0) -> None:
        self.name = name
        self.disk = disk
        self.alive = True
        self.suspended = False
        self.frozen: list[tuple[Fiber, bool]] = []
        self.wall_offset_ms = wall_offset_ms
        self.monotonic_offset_s = monotonic_offset_s
        self.crash_in = 0
        self.on_crash: Callable[[], None] = lambda: None


class Fiber(greenlet):  # type: ignore[misc]
    """One thread of a simulated process."""

    process: Process


class Ticket:
    """A blocked thread; it is resumed once."""

    __slots__ = ("_fiber", "_fired", "_scheduler", "timer")

    def __init__(self, scheduler: "Scheduler", fiber: Fiber) -> None:
        self._scheduler = scheduler
        self._fiber = fiber
        self._fired = False
        self.timer: Any = None

    def fire(self, woken: bool = True) -> None:
        """Resume the thread. The event loop calls this."""
        if self._fired:
            return
        self._fired = True
        if self.timer is not None:
            self.timer.cancel()
        self._scheduler.resume(self._fiber, woken)


class Scheduler:
    """The threads of all processes.

    Args:
        loop: The event loop.
        rng: Decides where threads are interrupted.
        crashed: Called with process and error when an exception ends a thread.
    """

    def __init__(self, loop: VirtualTimeLoop, rng: random.Random, *, crashed: Callable[[Process, str], None]) -> None:
        self.loop = loop
        self._rng = rng
        self._crashed = crashed
        self._hub = getcurrent()
        self._fibers: list[Fiber] = []
        self._until_yield = 1 << 60
        self.ended = False

    def interrupt_threads(self, every: int) -> None:
        """From now on, switch to another thread about once in this number of lock and disk operations."""
        self._every = every
        self._until_yield = self._rng.randint(1, 2 * every)

    def start(self, process: Process, run: Callable[[], None]) -> Fiber:
        """Run a function in a new thread of a process."""

        def guarded() -> None:
            try:
                run()
            except (Killed, GreenletExit):
                pass
            except Exception as error:  # noqa: BLE001 (as a real thread: it ends)
                if self.ended:
                    return
                where = traceback.extract_tb(error.__traceback__)[-1]
                self._crashed(process, f"{error!r} in {where.name}")

        fiber = Fiber(guarded, self._hub)
        fiber.process = process
        self._fibers.append(fiber)
        self.loop.call_soon(self.resume, fiber, True)
        return fiber

    def resume(self, fiber: Fiber, woken: bool) -> None:
        """Continue a thread until it blocks again."""
        if not fiber.process.alive or fiber.dead:
            return
        if fiber.process.suspended:
            fiber.process.frozen.append((fiber, woken))
            return
        if fiber:  # started
            fiber.switch(woken)
        else:
            fiber.switch()

    def block(self, waiting: list[Ticket] | None, timeout_s: float | None) -> bool:
        """Block the current thread. Returns whether it was woken before the timeout."""
        fiber = getcurrent()
        if self.ended:
            raise Killed
        assert isinstance(fiber, Fiber), "the event loop must not block"
        ticket = Ticket(self, fiber)
        if waiting is not None:
            waiting.append(ticket)
        if timeout_s is not None:
            ticket.timer = self.loop.call_later(max(SHORTEST_S, timeout_s), ticket.fire, False)
        woken: bool = self._hub.switch()
        if self.ended:
            raise Killed
        return woken

    def wake(self, waiting: list[Ticket]) -> None:
        """Wake all threads that wait in this list."""
        for ticket in waiting:
            self.loop.call_soon(ticket.fire, True)
        waiting.clear()

    def maybe_yield(self) -> None:
        """Let other threads run, if it is their turn."""
        self._until_yield -= 1
        if self._until_yield > 0:
            return
        self._until_yield = self._rng.randint(1, 2 * self._every)
        if isinstance(getcurrent(), Fiber):
            self.block(None, 0.0 if self._rng.random() < 0.8 else self._rng.uniform(0.0, 0.02))

    def disk_access(self) -> None:
        """Kill the current process if its planned crash is due."""
        fiber = getcurrent()
        if not isinstance(fiber, Fiber):
            return
        self.maybe_yield()
        process = fiber.process
        if process.crash_in:
            process.crash_in -= 1
            if not process.crash_in:
                process.on_crash()
                self._hub.switch()
                raise Killed

    def suspend(self, process: Process) -> None:
        """Freeze all threads of a process, as SIGSTOP does."""
        process.suspended = True

    def continue_(self, process: Process) -> None:
        """Continue a suspended process."""
        process.suspended = False
        frozen, process.frozen = process.frozen, []
        for fiber, woken in frozen:
            self.loop.call_soon(self.resume, fiber, woken)

    def end(self) -> None:
        """End all threads."""
        self.ended = True
        for fiber in self._fibers:
            if fiber and not fiber.dead:
                fiber.throw(Killed)
        self._fibers.clear()


def current_process() -> Process | None:
    """The process of the running thread; ``None`` in the cloud."""
    fiber = getcurrent()
    return fiber.process if isinstance(fiber, Fiber) else None
