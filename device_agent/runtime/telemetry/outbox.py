"""Outbox: stores and forwards events, and measurements that were taken without a link.

Callers never wait. The outbox's own thread writes to disk, sends at a low rate while the link is up, repeats messages
until they are delivered, and then deletes them. A full disk does not stop it.
"""

import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from device_agent.ports.clock import wall_ms
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol import codec, topics
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, event_message
from device_agent.runtime.storage.outbox_store import DroppedCount, OutboxItem, OutboxStore, OutboxStoreError, device_of

Publish = Callable[..., bool]
"""``Transport.publish``."""

RATE_HZ = 20.0
"""Maximum rate of stored messages: a tenth of the live messages of one moving robot and its camera [Hz]."""
BUSY_RATE_HZ = 5.0
"""Maximum rate while a device moves [Hz]."""
FIRST_REPEAT_S, LAST_REPEAT_S = 1.0, 8.0
"""An undelivered message is sent again after this time, then after twice the time, up to the second value [s]."""
_WINDOW = 10
"""Undelivered messages of the last ``FIRST_REPEAT_S``; a live message waits behind at most this many."""
_MAX_LATE = 50
"""Undelivered measurements that are repeated; further ones wait. Events never wait for a delivery."""
_UNCERTAIN_S = 10.0
"""Measurements sent this shortly before the loss of the link was detected are stored as well [s]."""
_MAX_UNSAVED = 500
_MAX_INCOMING = 5000
_SAVE_RETRY_S = 5.0
_PERIOD_S = 0.25
_DRAIN_S = 0.5
_STOP_S = 3.0
"""``stop`` waits at most this long for a hanging disk [s]."""
_RESPONSE_S = 60.0
"""An outbox without progress for this time hangs [s]; opening a large file on a slow disk takes long."""
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _SampledStream:
    """Sampled measurements of one topic: when the next one is due [s], and those that were sent recently."""

    due_s: float
    sent: deque[tuple[float, OutboxItem]]


@dataclass(frozen=True, slots=True)
class _Flight:
    """A sent message that is not delivered: when it was sent [s], and after which time it is sent again [s]."""

    late: bool
    sent_s: float
    pause_s: float


class Outbox:
    """The outbox of an agent. ``add_event`` and ``add_measurement`` are thread-safe and never block.

    Args:
        store: Not yet open.
        publish: Sends a message.
        device_topic: Topic ``ts/v1/{space}/{agent}/{device}`` under which disk errors are reported.
        is_quiet: Whether nothing moves.
        keep_hz: Maximum rate of stored measurements of one stream [Hz].
    """

    def __init__(
        self,
        store: OutboxStore,
        *,
        publish: Publish,
        device_topic: str,
        is_quiet: Callable[[], bool] = lambda: True,
        keep_hz: float = 1.0,
    ) -> None:
        self._store = store
        self._publish = publish
        self._device_topic = device_topic
        self._is_quiet = is_quiet
        self._period_s = 1 / keep_hz
        # The lock protects these; all others belong to the outbox's thread.
        self._lock = threading.Lock()
        self._streams: dict[str, _SampledStream] = {}
        self._incoming: deque[OutboxItem] = deque()
        self._lost: Counter[tuple[str, bool]] = Counter()
        self._delivered: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._up = threading.Event()
        self._connected = threading.Event()
        self._thread = SupervisedThread(
            self._run,
            name="outbox",
            part="outbox",
            stopping=self._stopping,
            recovery=Recovery.RESTART_OR_EXIT,
            within_s=_RESPONSE_S,
        )
        # Numbers above 0 are rows on disk; numbers below 0 are only in memory.
        self._open = False
        self._error = ""
        self._save_retry_s = float("-inf")
        self._unsaved: dict[int, OutboxItem] = {}
        self._number = 0
        self._in_flight: dict[int, _Flight] = {}
        self._sent = {False: 0, True: 0}
        self._tokens = float(_WINDOW)
        self._filled_s = float("inf")

    # ------------------------------------------------------------ any thread

    def start(self) -> None:
        """Start to store and send. Never fails: without a disk, it keeps events in memory and reports the error."""
        self._thread.start()

    def stop(self) -> None:
        """Store the rest, and send the last messages if the link is up. May be called twice."""
        self._stopping.set()
        self._wake.set()
        self._thread.join(timeout=_STOP_S)

    @property
    def stored_bytes(self) -> int:
        """Size of the messages on disk [bytes]."""
        return self._store.stored_bytes

    def add_event(self, topic: str, payload: bytes, *, at_ms: int) -> None:
        """Store an event, and send it as soon as possible."""
        with self._lock:
            self._add(OutboxItem(topic, payload, at_ms, late=False))
        self._wake.set()

    def add_measurement(self, topic: str, payload: bytes, *, at_ms: int, sent: bool, now_s: float) -> None:
        """Store a measurement at the reduced rate; if ``sent``, only if the link turns out to be lost.

        It is quick enough for the control loop.
        """
        with self._lock:
            stream = self._streams.setdefault(topic, _SampledStream(now_s, deque()))
            if now_s < stream.due_s:
                return
            stream.due_s = now_s + self._period_s
            item = OutboxItem(topic, payload, at_ms, late=True)
            if not sent:
                self._add(item)
                return
            stream.sent.append((now_s, item))
            while now_s - stream.sent[0][0] > _UNCERTAIN_S:
                stream.sent.popleft()

    def link_changed(self, up: bool) -> None:
        """Handle a change of the link."""
        if up:
            self._connected.set()
            self._up.set()
        else:
            self._up.clear()
            with self._lock:
                for stream in self._streams.values():
                    for _, item in stream.sent:
                        self._add(item)
                    stream.sent.clear()
        self._wake.set()

    def _add(self, item: OutboxItem) -> None:
        if len(self._incoming) >= _MAX_INCOMING:
            self._lose(self._incoming.popleft())
        self._incoming.append(item)

    def _lose(self, item: OutboxItem) -> None:
        self._lost[device_of(item.topic), item.late] += 1

    # ------------------------------------------------------------ the outbox's thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._thread.beat()
            self._wake.wait(_PERIOD_S)
            self._wake.clear()
            self._iterate(time.monotonic())
        deadline_s = time.monotonic() + _DRAIN_S
        self._iterate(time.monotonic())
        while self._up.is_set() and self._in_flight and time.monotonic() < deadline_s:
            time.sleep(0.01)
            self._iterate(time.monotonic())
        self._store.close()

    def _iterate(self, now_s: float) -> None:
        try:
            self._remove_delivered()
            self._save(now_s)
            if self._connected.is_set():
                self._connected.clear()
                self._resend_all()
            if self._up.is_set():
                self._send(now_s)
        except OutboxStoreError as error:
            self._fail(error, now_s)
        except Exception:  # noqa: BLE001 (any error: later messages must still be stored)
            _log.exception("outbox")

    def _remove_delivered(self) -> None:
        """Delete delivered messages."""
        saved = []
        while not self._delivered.empty():
            number = self._delivered.get()
            self._in_flight.pop(number, None)
            self._unsaved.pop(number, None)
            if number > 0:
                saved.append(number)
        if saved:
            self._store.remove(saved)

    def _save(self, now_s: float) -> None:
        """Store new messages, and those that could not be stored before."""
        with self._lock:
            incoming, self._incoming = self._incoming, deque()
        if self._open and not (incoming or self._unsaved or self._lost):
            return
        if now_s < self._save_retry_s:
            self._keep_in_memory(incoming)
            return
        try:
            if not self._open:
                self._store.open()
                self._open = True
            self._store.put([*self._unsaved.values(), *incoming], now_ms=wall_ms())
        except OutboxStoreError as error:
            self._keep_in_memory(incoming)
            self._fail(error, now_s)
            return
        for number in self._unsaved:  # now rows on disk
            self._in_flight.pop(number, None)
        self._unsaved.clear()
        if self._error:
            _log.warning("unsent messages are stored on disk again")
            self._error = ""
        with self._lock:
            lost, self._lost = self._lost, Counter()
        if lost:
            self._store.count(lost)

    def _keep_in_memory(self, items: Iterable[OutboxItem]) -> None:
        """Keep a bounded number of events in memory; drop and count measurements."""
        for item in items:
            if not item.late and len(self._unsaved) < _MAX_UNSAVED:
                self._number -= 1
                self._unsaved[self._number] = item
            else:
                with self._lock:
                    self._lose(item)

    def _fail(self, error: OutboxStoreError, now_s: float) -> None:
        self._save_retry_s = now_s + _SAVE_RETRY_S
        if self._error:
            return
        self._error = str(error)
        _log.error("unsent messages cannot be stored on disk: %s", error)
        event = EventRecord(EventKind.BUFFER_FAILED, self._error, "error", {"code": "disk"}, wall_ms())
        self._keep_in_memory([_event_item(self._device_topic, event)])

    # ------------------------------------------------------------ sending

    def _resend_all(self) -> None:
        """Mark all stored messages as unsent, including those in flight: the link is new."""
        self._in_flight.clear()
        self._sent = {False: 0, True: 0}
        if self._open:
            self._store.enforce_bounds(now_ms=wall_ms())
            self._store.store_dropped_events(_dropped_event)

    def _send(self, now_s: float) -> None:
        rate_hz = RATE_HZ if self._is_quiet() else BUSY_RATE_HZ
        self._tokens = min(float(_WINDOW), self._tokens + max(0.0, now_s - self._filled_s) * rate_hz)
        self._filled_s = now_s
        recent = sum(now_s - flight.sent_s < FIRST_REPEAT_S for flight in self._in_flight.values())
        for number, item in self._next(now_s, min(int(self._tokens), _WINDOW - recent)):
            if not self._publish(item.topic, item.payload, qos=1, delivered=partial(self._on_delivered, number)):
                return
            before = self._in_flight.get(number)
            pause_s = FIRST_REPEAT_S if before is None else min(2 * before.pause_s, LAST_REPEAT_S)
            self._in_flight[number] = _Flight(item.late, now_s, pause_s)
            self._tokens -= 1
            self._sent[item.late] = max(self._sent[item.late], number)

    def _next(self, now_s: float, limit: int) -> list[tuple[int, OutboxItem]]:
        """The next messages: new events, then undelivered messages whose repetition is due, then new measurements."""
        items = [item for item in self._unsaved.items() if item[0] not in self._in_flight][: max(0, limit)]
        items += self._new(limit - len(items), late=False)
        items += self._due(now_s, limit - len(items))
        late = sum(flight.late for flight in self._in_flight.values())
        return items + self._new(min(limit - len(items), _MAX_LATE - late), late=True)

    def _new(self, limit: int, *, late: bool) -> list[tuple[int, OutboxItem]]:
        """Stored messages that were not sent over this link, oldest first."""
        return self._store.after(self._sent[late], late=late, limit=limit) if self._open and limit > 0 else []

    def _due(self, now_s: float, limit: int) -> list[tuple[int, OutboxItem]]:
        """Undelivered messages to send again, those that have waited longest first."""
        due = [number for number, flight in self._in_flight.items() if now_s - flight.sent_s >= flight.pause_s]
        due = sorted(due, key=lambda number: self._in_flight[number].sent_s)[: max(0, limit)]
        stored = self._store.get([number for number in due if number > 0]) if self._open and due else {}
        items = self._unsaved | stored
        for number in due:
            if number not in items:  # dropped: the outbox is full
                del self._in_flight[number]
        return [(number, items[number]) for number in due if number in items]

    def _on_delivered(self, number: int) -> None:
        self._delivered.put(number)
        self._wake.set()


def _dropped_event(dropped: DroppedCount) -> OutboxItem:
    """The event that reports dropped messages."""
    counts = {"measurements": dropped.measurements, "events": dropped.events}
    message = f"dropped, unsent: {dropped.measurements} measurements, {dropped.events} events"
    return _event_item(dropped.device, EventRecord(EventKind.BUFFER_DROPPED, message, "warning", counts, wall_ms()))


def _event_item(device: str, event: EventRecord) -> OutboxItem:
    message = event_message(device.rpartition("/")[2], event)
    return OutboxItem(f"{device}/{topics.EVENT}", codec.encode(message), message.at_ms, late=False)
