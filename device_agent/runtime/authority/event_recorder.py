"""What happened at one device, on its way to being told: whoever notes it never waits, and floods are counted.

The control loop, the transport's thread and the office note; the office alone takes out and publishes.
"""

import threading
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from device_agent.ports.clock import wall_ms
from device_agent.protocol import Event
from device_agent.protocol.events import EventKind

Severity = Literal["info", "warning", "error"]

GAP_S = 5.0
"""The same refusal is told at most once in this time; those between are counted."""
_MOST_WAITING = 500
_LONGEST = 2000
_MOST_COUNTED = 64
"""Different refusals that are counted one by one; codes are few, so more than these is no honest traffic."""


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One fact, with its own time [ms since 1970]."""

    kind: EventKind
    message: str
    severity: Severity = "info"
    data: Mapping[str, Any] = field(default_factory=dict)
    at_ms: int = 0


Tell = Callable[[EventRecord], None]
"""Takes in a fact; quick, never blocks, never raises."""


@dataclass(slots=True)
class _Flood:
    """One refusal that comes again: how often since it was last told, and the newest of them."""

    told_s: float
    newest: EventRecord
    count: int = 0


def ignore_event(_happened: EventRecord) -> None:
    """For whoever is watched by nobody."""


class EventRecorder:
    """The facts of one device that wait to be told. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[EventRecord] = deque()
        self._floods: dict[tuple[EventKind, str], _Flood] = {}
        self._lost = 0

    def note(self, happened: EventRecord) -> None:
        """Something happened now."""
        with self._lock:
            self._add(_stamped(happened))

    def refused(self, happened: EventRecord, *, code: str, now_s: float) -> None:
        """Something was refused, perhaps not for the first time.

        Args:
            happened: What to tell.
            code: What makes two refusals of one kind the same.
            now_s: Monotonic clock [s].
        """
        with self._lock:
            key = (happened.kind, code)
            flood = self._floods.get(key)
            if flood is not None:
                flood.newest, flood.count = _stamped(happened), flood.count + 1
            elif len(self._floods) < _MOST_COUNTED:
                told = _stamped(happened)
                self._floods[key] = _Flood(now_s, told)
                self._add(told)
            else:
                self._lost += 1

    def take(self, now_s: float) -> list[EventRecord]:
        """What is to be told now, oldest first.

        Args:
            now_s: Monotonic clock [s].
        """
        with self._lock:
            found = list(self._waiting)
            self._waiting.clear()
            for key, flood in list(self._floods.items()):
                if now_s - flood.told_s < GAP_S:
                    continue
                if not flood.count:
                    del self._floods[key]
                    continue
                newest = flood.newest
                data = {**newest.data, "count": flood.count}
                found.append(EventRecord(newest.kind, newest.message, newest.severity, data, newest.at_ms))
                flood.told_s, flood.count = now_s, 0
            if self._lost:
                message = f"{self._lost} events are not told one by one: too much happened at once"
                found.append(_stamped(EventRecord(EventKind.EVENTS_DROPPED, message, "warning", {"count": self._lost})))
                self._lost = 0
            return found

    def _add(self, happened: EventRecord) -> None:
        if len(self._waiting) >= _MOST_WAITING:
            self._lost += 1
            return
        self._waiting.append(happened)


def event_of(device: str, happened: EventRecord) -> Event:
    """A fact as it is told.

    Args:
        device: Name of the device.
        happened: With its time.
    """
    return Event(
        id=uuid.uuid4().hex,
        device=device,
        at_ms=happened.at_ms,
        kind=happened.kind,
        severity=happened.severity,
        message=happened.message[:_LONGEST],
        data=dict(happened.data),
    )


def _stamped(happened: EventRecord) -> EventRecord:
    return EventRecord(happened.kind, happened.message, happened.severity, happened.data, happened.at_ms or wall_ms())
