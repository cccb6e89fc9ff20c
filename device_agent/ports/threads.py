"""Supervised threads. Every thread of the agent is started here, so that none can end or hang unnoticed.

A loop calls ``beat`` in each iteration. ``runtime.supervision`` compares the beats of all threads with their limits.
"""

import logging
import math
import threading
import time
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

_log = logging.getLogger(__name__)


class Recovery(Enum):
    """What the supervisor does after a thread has ended unexpectedly. It always holds the devices and reports it."""

    NONE = "none"
    """Nothing: the thread was a single task."""
    RESTART = "restart"
    """Start the thread again; after repeated failures it stays ended."""
    RESTART_OR_EXIT = "restart or exit"
    """Start the thread again; after repeated failures, or if it hangs, end the agent's process."""
    EXIT = "exit"
    """End the agent's process, so that the service manager starts it again."""


class Beat(NamedTuple):
    """Time of a report of progress on the monotonic clock, and the time within which the next one follows [s]."""

    at_s: float
    within_s: float


class SupervisedThread:
    """A daemon thread that the agent's supervisor watches.

    Args:
        target: Runs in the thread.
        name: Name of the thread.
        part: What it is, for operators: ``control loop``.
        stopping: Set before the thread is expected to end; ``None``: a task, which may return at any time.
        recovery: What happens after an unexpected end.
        device: Name of the device that it belongs to; empty: the whole agent.
        within_s: Maximum time between two beats [s].

    Attributes:
        error: The exception with which the thread ended.
        last: The last beat.
    """

    def __init__(
        self,
        target: Callable[[], None],
        *,
        name: str,
        part: str,
        stopping: threading.Event | None = None,
        recovery: Recovery = Recovery.NONE,
        device: str = "",
        within_s: float = math.inf,
    ) -> None:
        self._target = target
        self._stopping = stopping
        self._within_s = within_s
        self._thread: threading.Thread | None = None
        self._starting = False
        self.name = name
        self.part = part
        self.recovery = recovery
        self.device = device
        self.error: BaseException | None = None
        self.last = Beat(-math.inf, within_s)

    def start(self) -> None:
        """Start the thread, or start it again after it has ended."""
        self.error = None
        self.beat()
        self._starting = True  # so that the supervisor does not take a thread that does not run yet for an ended one
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        with _lock:
            _started.add(self)
        try:
            self._thread.start()
        finally:
            self._starting = False

    def beat(self, within_s: float | None = None) -> None:
        """Report progress. The next report follows within this time [s], by default that of the thread."""
        self.last = Beat(time.monotonic(), self._within_s if within_s is None else within_s)

    def is_alive(self) -> bool:
        """Whether the thread runs or is being started."""
        return self._thread is not None and (self._starting or self._thread.is_alive())

    def is_current(self) -> bool:
        """Whether the caller runs in this thread."""
        return self._thread is threading.current_thread()

    def join(self, timeout: float | None = None) -> None:
        """Wait until the thread has ended, at most ``timeout`` [s]. Returns at once if it was never started."""
        if self._thread is not None:
            self._thread.join(timeout)

    @property
    def responsive(self) -> bool:
        """Whether the thread runs and its next beat is not overdue."""
        return self.is_alive() and time.monotonic() - self.last.at_s <= self.last.within_s

    @property
    def failed(self) -> bool:
        """Whether the thread has ended unexpectedly."""
        if self._thread is None or self.is_alive():
            return False
        return self.error is not None if self._stopping is None else not self._stopping.is_set()

    @property
    def due(self) -> bool:
        """Whether progress is still expected: the thread was not asked to end."""
        return self._stopping is None or not self._stopping.is_set()

    def forget(self) -> None:
        """Do not watch the thread any more."""
        with _lock:
            _started.discard(self)

    def _run(self) -> None:
        try:
            self._target()
        except BaseException as error:  # noqa: BLE001 (the supervisor reports every end)
            _log.exception("thread %s", self.name)
            self.error = error
        if self.error is None and (self._stopping is None or self._stopping.is_set()):
            self.forget()


_lock = threading.Lock()
_started: set[SupervisedThread] = set()


def watched() -> list[SupervisedThread]:
    """All threads that were started and have not ended as expected."""
    with _lock:
        threads = list(_started)
    for thread in threads:
        if not (thread.is_alive() or thread.failed):
            thread.forget()
    return [thread for thread in threads if thread.is_alive() or thread.failed]
