"""Events of one device between their occurrence and their publication. Repeated rejections are counted.

The control loop, the transport's thread and the command processor record events without blocking. Only the command
processor drains and publishes them.
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
"""Minimum time between two events for the same rejection; those in between are counted [s]."""
_MAX_WAITING = 500
_MAX_MESSAGE = 2000
_MAX_COUNTED = 64
"""Number of different rejections that are counted individually. Legitimate traffic has fewer codes."""


@dataclass(frozen=True, slots=True)
class EventRecord:
    """One event with the time of its occurrence [ms since 1970]; 0 means now."""

    kind: EventKind
    message: str
    severity: Severity = "info"
    data: Mapping[str, Any] = field(default_factory=dict)
    at_ms: int = 0


RecordEvent = Callable[[EventRecord], None]
"""Records an event; never blocks, never raises."""


@dataclass(slots=True)
class _Repeated:
    """A rejection that occurs repeatedly: time of its last event [s], newest occurrence, occurrences since then."""

    published_s: float
    newest: EventRecord
    count: int = 0


def ignore_event(_event: EventRecord) -> None:
    """Discard an event; the default of components that run without a recorder."""


class EventRecorder:
    """Events of one device that wait for publication. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[EventRecord] = deque()
        self._repeated: dict[tuple[EventKind, str], _Repeated] = {}
        self._lost = 0

    def record(self, event: EventRecord) -> None:
        """Record an event that occurred now."""
        with self._lock:
            self._add(_stamped(event))

    def record_rejection(self, event: EventRecord, *, code: str, now_s: float) -> None:
        """Record a rejection; repeated ones of a kind with the same ``code`` are counted. ``now_s``: monotonic."""
        with self._lock:
            key = (event.kind, code)
            repeated = self._repeated.get(key)
            if repeated is not None:
                repeated.newest, repeated.count = _stamped(event), repeated.count + 1
            elif len(self._repeated) < _MAX_COUNTED:
                stamped = _stamped(event)
                self._repeated[key] = _Repeated(now_s, stamped)
                self._add(stamped)
            else:
                self._lost += 1

    def drain(self, now_s: float) -> list[EventRecord]:
        """Remove and return the events to publish now, oldest first; at infinity, also all counted rejections."""
        with self._lock:
            events = list(self._waiting)
            self._waiting.clear()
            for key, repeated in list(self._repeated.items()):
                if now_s - repeated.published_s < GAP_S:
                    continue
                if not repeated.count:
                    del self._repeated[key]
                    continue
                newest = repeated.newest
                data = {**newest.data, "count": repeated.count}
                events.append(EventRecord(newest.kind, newest.message, newest.severity, data, newest.at_ms))
                repeated.published_s, repeated.count = now_s, 0
            if self._lost:
                message = f"{self._lost} events were not recorded individually: too many occurred in a short time"
                events.append(
                    _stamped(EventRecord(EventKind.EVENTS_DROPPED, message, "warning", {"count": self._lost}))
                )
                self._lost = 0
            return events

    def _add(self, event: EventRecord) -> None:
        if len(self._waiting) >= _MAX_WAITING:
            self._lost += 1
            return
        self._waiting.append(event)


def event_message(device: str, event: EventRecord) -> Event:
    """The wire message of a recorded event."""
    return Event(
        id=uuid.uuid4().hex,
        device=device,
        at_ms=event.at_ms,
        kind=event.kind,
        severity=event.severity,
        message=event.message[:_MAX_MESSAGE],
        data=dict(event.data),
    )


def _stamped(event: EventRecord) -> EventRecord:
    return EventRecord(event.kind, event.message, event.severity, event.data, event.at_ms or wall_ms())
