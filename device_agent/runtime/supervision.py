"""Supervision of the agent's threads: notices within a second that one has ended or hangs, and acts.

The process's main thread calls ``check``. Delays of the main thread itself do not count as delays of other threads.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from device_agent.ports import threads
from device_agent.ports.clock import wall_ms
from device_agent.ports.threads import Beat, Recovery, SupervisedThread
from device_agent.protocol import Fault

CHECK_PERIOD_S = 0.1
"""Time between two checks [s]."""
MAX_RESTARTS = 3
"""A thread that ends again after this many restarts within ``RESTART_WINDOW_S`` is not restarted."""
RESTART_WINDOW_S = 60.0
REPORT_S = 1.5
"""Time between the end of an essential thread and the end of the process, to report the fault [s]."""
HANGING_S = 5.0
"""Time for which an essential thread may hang before the process ends [s]; a driver may respond again."""
SILENT_S = 2.0
"""Without a check for this time, the devices report that nothing supervises the agent [s]."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Failure:
    """A thread that has ended unexpectedly or hangs.

    Attributes:
        part: What it is, for operators.
        device: The device that it belongs to; empty: the whole agent.
        message: What happened, and what the agent does.
        lasts: Whether the failure lasts until ``part_recovered``; that of a single task is over at once.
    """

    part: str
    device: str
    message: str
    lasts: bool = True


class SteadyClock:
    """The time of one thread, which does not advance while the thread itself or the whole process is suspended."""

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self._clock_s = clock_s
        self._last_s = clock_s()
        self._now_s = 0.0

    def advance(self) -> float:
        """The present time [s]; to be called every ``CHECK_PERIOD_S``."""
        clock_s = self._clock_s()
        self._now_s += min(clock_s - self._last_s, 2 * CHECK_PERIOD_S)
        self._last_s = clock_s
        return self._now_s


@dataclass(slots=True)
class _Watch:
    """The last beat, when it was noticed, the open failure and its start, the last end, and times of restarts [s]."""

    beat: Beat
    seen_s: float
    failure: Failure | None = None
    failed_s: float = 0.0
    ended: Beat | None = None
    restarts: list[float] = field(default_factory=list)

    @property
    def reason(self) -> str:
        return "" if self.failure is None else self.failure.message


class Listener(Protocol):
    """A device, as the supervisor sees it. Neither method blocks."""

    @property
    def name(self) -> str:
        """Name of the device."""

    def part_failed(self, failure: Failure) -> None:
        """Hold and report."""

    def part_recovered(self, failure: Failure) -> None:
        """Report that the failure is over."""


class Supervisor:
    """Watches all threads that were started with ``ports.threads``. One thread calls ``check``.

    Attributes:
        checks: Number of checks; the devices report if it does not rise.
    """

    def __init__(
        self,
        *,
        clock_s: Callable[[], float] = time.monotonic,
        watched: Callable[[], Sequence[SupervisedThread]] = threads.watched,
    ) -> None:
        self._clock = SteadyClock(clock_s)
        self._watched = watched
        self._listeners: list[Listener] = []
        self._watches: dict[SupervisedThread, _Watch] = {}
        self._uncaught: queue.SimpleQueue[threading.ExceptHookArgs] = queue.SimpleQueue()
        self.checks = 0

    def add(self, listener: Listener) -> None:
        """Report failures to this device: of its own threads, and of those that all devices share."""
        self._listeners.append(listener)

    def start(self) -> None:
        """Report uncaught exceptions of other threads, such as timers and those of libraries, too."""
        threading.excepthook = self._uncaught.put

    def stop(self) -> None:
        """Undo ``start``."""
        threading.excepthook = threading.__excepthook__

    @property
    def healthy(self) -> bool:
        """Whether every essential thread runs: the condition for a notification of the service manager's watchdog."""
        return not any(watch.failure and thread.recovery in _ESSENTIAL for thread, watch in self._watches.items())

    def check(self) -> str:
        """Check every thread. Returns why the process must end now, or an empty string."""
        now_s = self._clock.advance()
        self.checks += 1
        self._report_uncaught()
        watched = self._watched()
        for gone in self._watches.keys() - set(watched):
            self._recover(self._watches.pop(gone))
        reasons = [self._check_thread(thread, now_s) for thread in watched]
        return next(filter(None, reasons), "")

    def _report_uncaught(self) -> None:
        while not self._uncaught.empty():
            uncaught = self._uncaught.get()
            name = "" if uncaught.thread is None else uncaught.thread.name
            _log.error("thread %s", name, exc_info=uncaught.exc_value)
            message = f"the thread {name} has ended: {uncaught.exc_value!r}"
            self._report(Failure(f"thread {name}", "", message, lasts=False))

    def _check_thread(self, thread: SupervisedThread, now_s: float) -> str:
        beat = thread.last
        watch = self._watches.setdefault(thread, _Watch(beat, now_s))
        if thread.failed:
            return self._handle_end(thread, watch, now_s)
        if beat != watch.beat:
            watch.beat, watch.seen_s = beat, now_s
            self._recover(watch)
        elif thread.due and now_s - watch.seen_s > beat.within_s:
            return self._handle_hang(thread, watch, now_s)
        return ""

    def _handle_end(self, thread: SupervisedThread, watch: _Watch, now_s: float) -> str:
        if watch.ended != thread.last:  # a new end
            watch.ended = thread.last
            watch.restarts = [at_s for at_s in watch.restarts if now_s - at_s < RESTART_WINDOW_S]
            restart = thread.recovery in _RESTARTED and len(watch.restarts) < MAX_RESTARTS
            cause = "it returned" if thread.error is None else f"internal error: {thread.error!r}"
            action = "it is started again" if restart else _CONSEQUENCE[thread.recovery]
            self._fail(thread, watch, f"the {thread.part} has ended ({cause}); {action}", now_s)
            if restart:
                watch.restarts.append(now_s)
                thread.start()
            elif thread.recovery is Recovery.NONE:
                thread.forget()
        return watch.reason if thread.recovery in _ESSENTIAL and now_s - watch.failed_s >= REPORT_S else ""

    def _handle_hang(self, thread: SupervisedThread, watch: _Watch, now_s: float) -> str:
        essential = thread.recovery in _ESSENTIAL
        if watch.failure is None:
            action = f"the agent restarts if this lasts for {HANGING_S:g} s" if essential else "the device holds"
            self._fail(thread, watch, f"the {thread.part} does not respond; {action}", now_s)
        return watch.reason if essential and now_s - watch.failed_s >= HANGING_S else ""

    def _fail(self, thread: SupervisedThread, watch: _Watch, message: str, now_s: float) -> None:
        failure = Failure(thread.part, thread.device, message, lasts=thread.recovery is not Recovery.NONE)
        watch.failure, watch.failed_s = failure if failure.lasts else None, now_s
        self._report(failure)

    def _report(self, failure: Failure) -> None:
        _log.error("%s %s", failure.device, failure.message)
        for listener in self._listeners:
            if failure.device in {"", listener.name}:
                listener.part_failed(failure)

    def _recover(self, watch: _Watch) -> None:
        failure, watch.failure = watch.failure, None
        if failure is None:
            return
        for listener in self._listeners:
            if failure.device in {"", listener.name}:
                listener.part_recovered(failure)


class PartFaults:
    """Faults of one device due to failed threads, and due to a supervisor that does not check. Thread-safe."""

    def __init__(self, supervisor: Supervisor, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._supervisor = supervisor
        self._clock = SteadyClock(clock_s)
        self._lock = threading.Lock()
        self._faults: dict[str, Fault] = {}
        self._recovered: set[str] = set()
        self._checks = 0
        self._checked_s = 0.0

    def add(self, failure: Failure) -> None:
        """Add the fault of a failure."""
        code = _code(failure)
        with self._lock:
            self._faults[code] = Fault(code=code, message=failure.message[:2000], since_ms=wall_ms())
            self._recovered.discard(code)

    def remove(self, failure: Failure) -> None:
        """Remove the fault once it has been read."""
        with self._lock:
            self._recovered.add(_code(failure))

    def present(self) -> tuple[Fault, ...]:
        """The present faults; a short one is returned at least once. One thread calls this, several times a second."""
        now_s, checks = self._clock.advance(), self._supervisor.checks
        if checks != self._checks:
            self._checks, self._checked_s = checks, now_s
        with self._lock:
            faults = tuple(self._faults.values())
            for code in self._recovered:
                self._faults.pop(code, None)
            self._recovered.clear()
        if checks and now_s - self._checked_s > SILENT_S:
            message = "the agent's threads are not supervised: its main thread hangs; restart the agent"
            faults += (Fault(code="agent.supervisor", message=message, since_ms=wall_ms()),)
        return faults


def _code(failure: Failure) -> str:
    return "agent." + failure.part.lower().replace(" ", "-")


_ESSENTIAL = frozenset({Recovery.EXIT, Recovery.RESTART_OR_EXIT})
_RESTARTED = frozenset({Recovery.RESTART, Recovery.RESTART_OR_EXIT})
_CONSEQUENCE = {
    Recovery.NONE: "the device holds",
    Recovery.RESTART: "it failed repeatedly and is not started again; restart the agent",
    Recovery.RESTART_OR_EXIT: "it failed repeatedly; the agent restarts",
    Recovery.EXIT: "the agent restarts",
}
