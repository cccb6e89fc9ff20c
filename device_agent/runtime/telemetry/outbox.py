"""What the agent has to say and may not lose: events always, measurements while nobody hears them.

Whoever hands something in never waits: a thread of its own writes to disk, sends when the link is up, slowly enough
that nothing live waits for it, and deletes what the other side has confirmed. A disk that is full stops nothing.
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
from device_agent.protocol import codec, topics
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord, event_of
from device_agent.runtime.storage.outbox_store import DroppedCount, OutboxItem, OutboxStore, ShelfError, device_of

Publish = Callable[..., bool]
"""``Transport.publish``."""

RATE_HZ = 20.0
"""Messages a second at most from what was kept; a tenth of what one robot in motion and its camera send live."""
BUSY_RATE_HZ = 5.0
"""As above while something moves."""
_WINDOW = 10
"""Messages under way at once, so that a live one never stands behind more than these."""
_UNSURE_S = 10.0
"""A link is lost before that is noticed: what was measured so shortly before is kept as well."""
_CONFIRM_S = 30.0
"""What was not confirmed in this time is sent again."""
_TRIES = 5
"""What was not confirmed so often, though the link is up, is refused by the other side: it is dropped and counted."""
_MOST_UNSAVED = 500
_MOST_INCOMING = 5000
_SAVE_AGAIN_S = 5.0
_ROUND_S = 0.25
_LAST_WORDS_S = 0.5
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Unsure:
    """Thinned measurements of one topic: when the next one is due, and those that were sent lately [s]."""

    due_s: float
    sent: deque[tuple[float, OutboxItem]]


class Outbox:
    """One for an agent. ``happened`` and ``measured`` are thread-safe and never block.

    Args:
        shelf: Not yet open.
        publish: Sends a message.
        teller: Device topic, ``ts/v1/{space}/{agent}/{device}``, under which trouble with the disk is told.
        quiet: Whether nothing moves.
        keep_hz: Measurements of one stream that are kept in a second, at most [Hz].
        settle_s: After the link has come nothing is sent for so long [s]: where the other side confirms before it has
            stored, as a broker does, whoever stores may still be on the way back.
    """

    def __init__(
        self,
        shelf: OutboxStore,
        *,
        publish: Publish,
        teller: str,
        quiet: Callable[[], bool] = lambda: True,
        keep_hz: float = 1.0,
        settle_s: float = 0.0,
    ) -> None:
        self._shelf = shelf
        self._publish = publish
        self._teller = teller
        self._quiet = quiet
        self._period_s = 1 / keep_hz
        self.settle_s = settle_s
        self._send_from_s = float("inf")
        # What other threads touch; the rest is the own thread's.
        self._lock = threading.Lock()
        self._streams: dict[str, _Unsure] = {}
        self._incoming: deque[OutboxItem] = deque()
        self._lost: Counter[tuple[str, bool]] = Counter()
        self._confirmed: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._up = threading.Event()
        self._began = threading.Event()
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        # Numbers above 0 are rows on disk, those below are in memory alone.
        self._open = False
        self._trouble = ""
        self._save_again_s = float("-inf")
        self._unsaved: dict[int, OutboxItem] = {}
        self._number = 0
        self._under_way: dict[int, float] = {}
        self._tries: Counter[int] = Counter()
        self._sent = {False: 0, True: 0}
        self._tokens = float(_WINDOW)
        self._filled_s = float("inf")

    # ------------------------------------------------------------ any thread

    def start(self) -> None:
        """Begin to keep and to send. Never fails: without a disk it keeps events in memory, and says so."""
        self._thread.start()

    def stop(self) -> None:
        """Save what is left, and let the last words go out where the link is up. May be called twice."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=3)

    def happened(self, topic: str, payload: bytes, *, at_ms: int) -> None:
        """Send an event, now or as soon as it can be; it is on disk before."""
        with self._lock:
            self._add(OutboxItem(topic, payload, at_ms, late=False))
        self._wake.set()

    def measured(self, topic: str, payload: bytes, *, at_ms: int, sent: bool, now_s: float) -> None:
        """Take note of a measurement, thinned; quick, for the control loop.

        Args:
            topic: Where it goes when it is late.
            payload: The message.
            at_ms: When it was measured [ms since 1970].
            sent: Whether the link took it; then it is kept only if the link turns out to be lost.
            now_s: Monotonic clock [s].
        """
        with self._lock:
            unsure = self._streams.setdefault(topic, _Unsure(now_s, deque()))
            if now_s < unsure.due_s:
                return
            unsure.due_s = now_s + self._period_s
            item = OutboxItem(topic, payload, at_ms, late=True)
            if not sent:
                self._add(item)
                return
            unsure.sent.append((now_s, item))
            while now_s - unsure.sent[0][0] > _UNSURE_S:
                unsure.sent.popleft()

    def link_changed(self, up: bool) -> None:
        """The link came or went."""
        if up:
            self._began.set()
            self._up.set()
        else:
            self._up.clear()
            with self._lock:
                for unsure in self._streams.values():
                    for _, item in unsure.sent:
                        self._add(item)
                    unsure.sent.clear()
        self._wake.set()

    def _add(self, item: OutboxItem) -> None:
        if len(self._incoming) >= _MOST_INCOMING:
            self._lose(self._incoming.popleft())
        self._incoming.append(item)

    def _lose(self, item: OutboxItem) -> None:
        self._lost[device_of(item.topic), item.late] += 1

    # ------------------------------------------------------------ its own thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._wake.wait(_ROUND_S)
            self._wake.clear()
            self._round(time.monotonic())
        deadline_s = time.monotonic() + _LAST_WORDS_S
        self._round(time.monotonic())
        while self._up.is_set() and self._under_way and time.monotonic() < deadline_s:
            time.sleep(0.01)
            self._round(time.monotonic())
        self._shelf.close()

    def _round(self, now_s: float) -> None:
        try:
            self._settle()
            self._save(now_s)
            if self._began.is_set():
                self._began.clear()
                self._send_from_s = now_s + self.settle_s
                self._begin()
            if self._up.is_set() and now_s >= self._send_from_s:
                self._send(now_s)
        except ShelfError as error:
            self._fail(error, now_s)
        except Exception:  # noqa: BLE001 (whatever it is: what comes next is kept all the same)
            _log.exception("outbox")

    def _settle(self) -> None:
        """Delete what has arrived."""
        saved = []
        while not self._confirmed.empty():
            number = self._confirmed.get()
            self._under_way.pop(number, None)
            self._tries.pop(number, None)
            self._unsaved.pop(number, None)
            if number > 0:
                saved.append(number)
        if saved:
            self._shelf.remove(saved)

    def _save(self, now_s: float) -> None:
        """Put on disk what came in, and what could not be put there before."""
        with self._lock:
            incoming, self._incoming = self._incoming, deque()
        if self._open and not (incoming or self._unsaved or self._lost):
            return
        if now_s < self._save_again_s:
            self._remember(incoming)
            return
        try:
            if not self._open:
                self._shelf.open()
                self._open = True
            self._shelf.put([*self._unsaved.values(), *incoming], now_ms=wall_ms())
        except ShelfError as error:
            self._remember(incoming)
            self._fail(error, now_s)
            return
        self._unsaved.clear()
        if self._trouble:
            _log.warning("what cannot be sent is kept on disk again")
            self._trouble = ""
        with self._lock:
            lost, self._lost = self._lost, Counter()
        if lost:
            self._shelf.count(lost)

    def _remember(self, items: Iterable[OutboxItem]) -> None:
        """Without a disk: events stay in memory, a bounded number; measurements are let go and counted."""
        for item in items:
            if not item.late and len(self._unsaved) < _MOST_UNSAVED:
                self._number -= 1
                self._unsaved[self._number] = item
            else:
                with self._lock:
                    self._lose(item)

    def _fail(self, error: ShelfError, now_s: float) -> None:
        self._save_again_s = now_s + _SAVE_AGAIN_S
        if self._trouble:
            return
        self._trouble = str(error)
        _log.error("what cannot be sent is not kept on disk: %s", error)
        happened = EventRecord(EventKind.BUFFER_FAILED, self._trouble, "error", {"code": "disk"}, wall_ms())
        self._remember([_item(self._teller, happened)])

    # ------------------------------------------------------------ sending

    def _begin(self) -> None:
        """A new link: all that is kept is still to be sent, also what was under way."""
        self._under_way.clear()
        self._sent = {False: 0, True: 0}
        if self._open:
            self._shelf.bound(now_ms=wall_ms())
            self._shelf.tell_dropped(_dropped)

    def _send(self, now_s: float) -> None:
        rate_hz = RATE_HZ if self._quiet() else BUSY_RATE_HZ
        self._tokens = min(float(_WINDOW), self._tokens + max(0.0, now_s - self._filled_s) * rate_hz)
        self._filled_s = now_s
        self._give_up_waiting(now_s)
        for number, item in self._next(min(int(self._tokens), _WINDOW - len(self._under_way))):
            self._under_way[number] = now_s
            if not self._publish(item.topic, item.payload, qos=1, delivered=partial(self._arrived, number)):
                del self._under_way[number]
                return
            self._tokens -= 1
            if number > 0:
                self._sent[item.late] = number

    def _next(self, most: int) -> list[tuple[int, OutboxItem]]:
        """What is to go out next: events before measurements, each oldest first."""
        found = [each for each in self._unsaved.items() if each[0] not in self._under_way][: max(0, most)]
        for late in (False, True):
            if self._open and len(found) < most:
                found += self._shelf.after(self._sent[late], late=late, limit=most - len(found))
        return found

    def _arrived(self, number: int) -> None:
        self._confirmed.put(number)
        self._wake.set()

    def _give_up_waiting(self, now_s: float) -> None:
        """What was not confirmed for long is sent again; what never is, let go and counted."""
        overdue = [number for number, sent_s in self._under_way.items() if now_s - sent_s > _CONFIRM_S]
        if not overdue:
            return
        self._under_way.clear()
        self._sent = {False: 0, True: 0}
        self._tries.update(overdue)
        refused = [number for number in overdue if self._tries[number] >= _TRIES]
        for number in refused:
            del self._tries[number]
            if number in self._unsaved:
                with self._lock:
                    self._lose(self._unsaved.pop(number))
        if refused:
            _log.error("%d messages were never confirmed and are let go", len(refused))
            self._shelf.drop(number for number in refused if number > 0)


def _dropped(dropped: DroppedCount) -> OutboxItem:
    """The event that tells what was dropped."""
    counts = {"measurements": dropped.measurements, "events": dropped.events}
    message = f"dropped, unsent: {dropped.measurements} measurements, {dropped.events} events"
    return _item(dropped.device, EventRecord(EventKind.BUFFER_DROPPED, message, "warning", counts, wall_ms()))


def _item(device: str, happened: EventRecord) -> OutboxItem:
    event = event_of(device.rpartition("/")[2], happened)
    return OutboxItem(f"{device}/{topics.EVENT}", codec.encode(event), event.at_ms, late=False)
