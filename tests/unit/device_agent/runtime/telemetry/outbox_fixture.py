"""An outbox whose clock and link the test controls."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from device_agent.protocol import Event, codec
from device_agent.protocol.events import EventKind
from device_agent.runtime.storage.outbox_store import OutboxStore, OutboxStoreError
from device_agent.runtime.telemetry.outbox import Outbox

ARM = "ts/v1/s/a/arm"
LATE = ARM + "/late/joints"


class OutboxFixture:
    """An outbox on a manual clock, and a link whose acceptance and acknowledgements the test controls."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "outbox.db"
        self.accepts = self.acknowledges = self.quiet = True
        self.sent: list[tuple[str, bytes]] = []
        self.open: list[Callable[[], None]] = []
        self.now_s = 1000.0
        self.restart()

    def restart(self, max_bytes: int = 10**6, keep_hz: float = 1.0) -> None:
        self.store = OutboxStore(self.path, own="ts/v1/s/a/", max_bytes=max_bytes, max_age_ms=10**15)
        self.outbox = Outbox(
            self.store, publish=self.publish, device_topic=ARM, is_quiet=lambda: self.quiet, keep_hz=keep_hz
        )

    def publish(self, topic: str, payload: bytes, *, qos: int, delivered: Callable[[], None]) -> bool:
        assert qos == 1
        if not self.accepts:
            return False
        self.sent.append((topic, payload))
        if self.acknowledges:
            delivered()
        else:
            self.open.append(delivered)
        return True

    def acknowledge(self) -> None:
        while self.open:
            self.open.pop(0)()

    def connect(self) -> None:
        self.outbox.link_changed(True)

    def iterate(self, count: int = 1, step_s: float = 0.25) -> None:
        for _ in range(count):
            self.now_s += step_s
            self.outbox._iterate(self.now_s)

    def iterate_for(self, seconds: float) -> None:
        self.iterate(int(4 * seconds))

    def event(self, *names: str) -> None:
        for name in names:
            self.outbox.add_event(ARM + "/event", name.encode(), at_ms=1)

    def measure(self, first: int, last: int, *, sent: bool = False, each_s: float = 1.0) -> None:
        for number in range(first, last):
            self.now_s += each_s
            self.outbox.add_measurement(LATE, str(number).encode(), at_ms=number, sent=sent, now_s=self.now_s)

    def stored(self, *, late: bool = False) -> list[str]:
        return [item.payload.decode() for _, item in self.store.after(0, late=late, limit=10**6)]

    def events(self) -> list[str]:
        """The events that were sent, except those of the outbox."""
        return [payload.decode() for topic, payload in self.sent if topic.endswith("/event") and payload[:1] != b"{"]

    def reports(self, kind: EventKind) -> list[Event]:
        """The outbox's own events that were sent."""
        events = [codec.decode(payload, Event) for _, payload in self.sent if payload.startswith(b"{")]
        return [event for event in events if event.kind == kind]


def fail(*_: Any, **__: Any) -> Any:
    raise OutboxStoreError("outbox.db cannot be written: is the disk full?")
