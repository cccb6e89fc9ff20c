"""``threading`` and ``queue`` for simulated threads: the part that the agent uses."""

import queue as real_queue
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from types import SimpleNamespace
from typing import Any

from greenlet import getcurrent

from tests.simulation.engine.scheduler import Fiber, Process, Scheduler, Ticket, current_process


def namespaces(scheduler: Scheduler) -> tuple[SimpleNamespace, SimpleNamespace]:
    """Replacements of the modules ``threading`` and ``queue``."""

    class Event(_Event):
        def __init__(self) -> None:
            super().__init__(scheduler)

    class Lock(_Lock):
        def __init__(self) -> None:
            super().__init__(scheduler)

    class Thread(_Thread):
        _scheduler = scheduler

    class Timer(Thread):
        """Calls a function after a delay, unless it is cancelled before."""

        def __init__(self, interval: float, function: Callable[..., Any], args: Iterable[Any] = ()) -> None:
            super().__init__()
            self._interval_s, self._function, self._arguments = interval, function, tuple(args)
            self._finished = Event()

        def cancel(self) -> None:
            self._finished.set()

        def run(self) -> None:
            if not self._finished.wait(self._interval_s):
                self._function(*self._arguments)

    class Queue(_Queue):
        def __init__(self, maxsize: int = 0) -> None:
            super().__init__(scheduler, maxsize)

    def current_thread() -> Any:
        return getattr(getcurrent(), "thread", None) or SimpleNamespace(name="main")

    threading = SimpleNamespace(
        Event=Event, Lock=Lock, RLock=Lock, Thread=Thread, Timer=Timer, current_thread=current_thread
    )
    queue = SimpleNamespace(Queue=Queue, SimpleQueue=Queue, Empty=real_queue.Empty, Full=real_queue.Full)
    return threading, queue


class _Event:
    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._flag = False
        self._waiting: list[Ticket] = []

    def is_set(self) -> bool:
        return self._flag

    def set(self) -> None:
        self._flag = True
        if self._waiting:
            self._scheduler.wake(self._waiting)

    def clear(self) -> None:
        self._flag = False

    def wait(self, timeout: float | None = None) -> bool:
        if not self._flag:
            self._scheduler.block(self._waiting, timeout)
        return self._flag


class _Lock:
    """A lock. Simulated threads are switched only where they block, so it is rarely contended."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._owner: object = None
        self._waiting: list[Ticket] = []

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        self._scheduler.maybe_yield()
        loop = self._scheduler.loop
        deadline_s = loop.time() + timeout if timeout >= 0 else None
        while self._owner is not None:
            left_s = None if deadline_s is None else deadline_s - loop.time()
            if not blocking or self._scheduler.ended or (left_s is not None and left_s <= 0):
                return False
            self._scheduler.block(self._waiting, left_s)
        self._owner = getcurrent()
        return True

    def release(self) -> None:
        self._owner = None
        if self._waiting:
            self._scheduler.wake(self._waiting)

    def locked(self) -> bool:
        return self._owner is not None

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class _Thread:
    _scheduler: Scheduler

    def __init__(
        self,
        group: None = None,
        target: Callable[..., Any] | None = None,
        name: str = "",
        args: Iterable[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        *,
        daemon: bool | None = None,
    ) -> None:
        del group
        self.name = name
        self.daemon = daemon
        self._target, self._args, self._kwargs = target, tuple(args), dict(kwargs or {})
        self._fiber: Fiber | None = None
        self._joining: list[Ticket] = []

    def start(self) -> None:
        process = current_process()
        assert process is not None, "only a simulated process starts threads"
        self.start_in(process)

    def start_in(self, process: Process) -> None:
        """Start the thread in a process."""
        self._fiber = self._scheduler.start(process, self._run)
        self._fiber.thread = self

    def _run(self) -> None:
        try:
            self.run()
        finally:
            self._scheduler.wake(self._joining)

    def run(self) -> None:
        if self._target is not None:
            self._target(*self._args, **self._kwargs)

    def is_alive(self) -> bool:
        return self._fiber is not None and not self._fiber.dead

    def join(self, timeout: float | None = None) -> None:
        if self.is_alive():
            self._scheduler.block(self._joining, timeout)


class _Queue:
    """``queue.Queue`` and ``queue.SimpleQueue``."""

    def __init__(self, scheduler: Scheduler, maxsize: int = 0) -> None:
        self._scheduler = scheduler
        self._maxsize = maxsize
        self._items: deque[Any] = deque()
        self._waiting: list[Ticket] = []

    def put(self, item: Any) -> None:
        self.put_nowait(item)

    def put_nowait(self, item: Any) -> None:
        if self._maxsize and len(self._items) >= self._maxsize:
            raise real_queue.Full
        self._items.append(item)
        if self._waiting:
            self._scheduler.wake(self._waiting)

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        if not self._items and block:
            self._scheduler.block(self._waiting, timeout)
        if not self._items:
            raise real_queue.Empty
        return self._items.popleft()

    def get_nowait(self) -> Any:
        return self.get(block=False)

    def empty(self) -> bool:
        return not self._items

    def qsize(self) -> int:
        return len(self._items)
