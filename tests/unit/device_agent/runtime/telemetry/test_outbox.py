"""Outbox: no event is lost, callers never wait, and live messages have priority."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import Event, codec, topics
from device_agent.protocol.events import EventKind
from device_agent.runtime.storage.outbox_store import OutboxItem, OutboxStore, OutboxStoreError
from device_agent.runtime.telemetry import outbox as module
from device_agent.runtime.telemetry.outbox import BUSY_RATE_HZ, RATE_HZ, Outbox
from tests.harness.agent.device_harness import eventually

ARM = "ts/v1/s/a/arm"
LATE = ARM + "/late/joints"


class Link:
    """A transport whose acceptance and acknowledgements the test controls."""

    def __init__(self) -> None:
        self.takes = True
        self.confirms = True
        self.said: list[tuple[str, bytes]] = []
        self.open: list[Callable[[], None]] = []

    def publish(self, topic: str, payload: bytes, *, qos: int, delivered: Callable[[], None]) -> bool:
        assert qos == 1
        if not self.takes:
            return False
        self.said.append((topic, payload))
        if self.confirms:
            delivered()
        else:
            self.open.append(delivered)
        return True

    def confirm(self) -> None:
        while self.open:
            self.open.pop(0)()

    def payloads(self, kind: str = topics.LATE) -> list[bytes]:
        return [payload for topic, payload in self.said if f"/{kind}" in topic]

    def events(self, kind: EventKind) -> list[Event]:
        found = [codec.decode(payload, Event) for payload in self.payloads(topics.EVENT) if payload.startswith(b"{")]
        return [event for event in found if event.kind == kind]


class DeviceHarness:
    """An outbox whose rounds are walked by hand."""

    def __init__(self, folder: Path, **limits: int) -> None:
        self.path = folder / "outbox.db"
        self.limits = {"max_bytes": 10**6, "max_age_ms": 10**15} | limits
        self.link = Link()
        self.now_s = 1000.0
        self.moves = False
        self.renew()

    def renew(self) -> None:
        """As after a restart."""
        self.store = OutboxStore(self.path, own="ts/v1/s/a/", **self.limits)
        self.outbox = Outbox(
            self.store, publish=self.link.publish, device_topic=ARM, is_quiet=lambda: not self.moves, keep_hz=1.0
        )

    def rounds(self, count: int = 1, step_s: float = 0.25) -> None:
        for _ in range(count):
            self.now_s += step_s
            self.outbox._iterate(self.now_s)

    def event(self, name: str) -> None:
        self.outbox.add_event(ARM + "/event", name.encode(), at_ms=1)

    def measure(self, first: int, last: int, *, sent: bool, each_s: float = 1.0) -> None:
        for number in range(first, last):
            self.now_s += each_s
            self.outbox.add_measurement(LATE, str(number).encode(), at_ms=number, sent=sent, now_s=self.now_s)

    def kept(self, *, late: bool = True) -> list[str]:
        return [found.payload.decode() for _, found in self.store.after(0, late=late, limit=10**6)]


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    harness = DeviceHarness(tmp_path)
    yield harness
    harness.store.close()


def test_an_event_is_stored_before_it_is_sent_and_deleted_after_the_ack(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.link.confirms = False
    harness.event("held")
    harness.rounds()
    assert harness.link.payloads(topics.EVENT) == [b"held"]
    assert harness.kept(late=False) == ["held"]
    harness.rounds(20)
    assert harness.link.payloads(topics.EVENT) == [b"held"], "it is under way"
    harness.link.confirm()
    harness.rounds()
    assert harness.kept(late=False) == []


def test_unacknowledged_messages_are_resent_in_order_after_a_lost_link(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.link.confirms = False
    for name in ("one", "two", "three"):
        harness.event(name)
    harness.rounds()
    harness.link.open.pop(0)()
    harness.outbox.link_changed(False)
    harness.rounds()
    harness.link.said.clear()
    harness.link.open.clear()
    harness.link.confirms = True
    harness.outbox.link_changed(True)
    harness.rounds(2)
    assert harness.link.payloads(topics.EVENT) == [b"two", b"three"]
    assert harness.kept(late=False) == []


def test_stored_messages_are_sent_after_a_restart(harness: DeviceHarness) -> None:
    harness.event("before")
    harness.measure(0, 3, sent=False)
    harness.rounds()
    harness.store.close()
    harness.renew()
    harness.outbox.link_changed(True)
    harness.rounds(4)
    assert [payload for _, payload in harness.link.said] == [b"before", b"0", b"1", b"2"], "events first"


def test_measurements_are_stored_at_a_reduced_rate_without_a_link(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.measure(0, 1000, sent=True, each_s=0.02)
    harness.rounds()
    assert harness.kept() == []
    harness.measure(1000, 2000, sent=False, each_s=0.02)
    harness.rounds()
    assert 19 <= len(harness.kept()) <= 21, "one a second of twenty seconds"


def test_measurements_sent_shortly_before_a_lost_link_are_stored(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.rounds()
    harness.measure(0, 30, sent=True)
    harness.outbox.link_changed(False)
    harness.measure(30, 32, sent=False)
    harness.rounds()
    assert harness.kept() == [str(number) for number in range(19, 32)], "the last ten seconds, in order"


def test_the_send_rate_is_low_and_lower_during_motion(harness: DeviceHarness) -> None:
    harness.measure(0, 500, sent=False)
    harness.rounds()
    harness.outbox.link_changed(True)
    harness.rounds(4)
    assert len(harness.link.said) <= module._WINDOW + RATE_HZ
    before = len(harness.link.said)
    harness.rounds(40)
    assert 9 * RATE_HZ <= len(harness.link.said) - before <= 11 * RATE_HZ
    harness.moves = True
    before = len(harness.link.said)
    harness.rounds(40)
    assert 9 * BUSY_RATE_HZ <= len(harness.link.said) - before <= 11 * BUSY_RATE_HZ
    assert harness.link.payloads() == [str(number).encode() for number in range(len(harness.link.said))]


def test_sending_starts_after_the_settle_time(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.outbox.settle_s = 8.0
    harness.event("held")
    for _ in range(2):
        harness.outbox.link_changed(True)
        harness.rounds(32)
        assert harness.link.said == []
    harness.rounds(2)
    assert harness.link.payloads(topics.EVENT) == [b"held"]
    harness.event("live")
    harness.rounds()
    assert harness.link.payloads(topics.EVENT) == [b"held", b"live"], "from then on at once"
    harness.store.close()


def test_messages_in_flight_are_limited(harness: DeviceHarness) -> None:
    harness.measure(0, 100, sent=False)
    harness.link.confirms = False
    harness.outbox.link_changed(True)
    harness.rounds(40)
    assert len(harness.link.said) == module._WINDOW
    harness.link.confirm()
    harness.rounds(8)
    assert len(harness.link.said) == 2 * module._WINDOW


def test_a_full_link_queue_is_retried(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.link.takes = False
    harness.event("held")
    harness.rounds(3)
    harness.link.takes = True
    harness.rounds()
    assert harness.link.payloads(topics.EVENT) == [b"held"]


def test_messages_without_ack_are_retried_then_dropped_and_counted(harness: DeviceHarness) -> None:
    harness.outbox.link_changed(True)
    harness.link.confirms = False
    harness.event("refused")
    harness.rounds(int(4 * module._ACK_TIMEOUT_S * (module._MAX_ATTEMPTS + 1)))
    assert harness.link.payloads(topics.EVENT).count(b"refused") == module._MAX_ATTEMPTS
    assert harness.kept(late=False) == []
    harness.outbox.link_changed(False)
    harness.outbox.link_changed(True)
    harness.rounds()
    (told,) = harness.link.events(EventKind.BUFFER_DROPPED)
    assert told.data == {"measurements": 0, "events": 1}


def test_dropped_messages_are_reported_after_reconnection(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path, max_bytes=50_000)
    harness.measure(0, 2000, sent=False)
    harness.rounds()
    left = len(harness.kept())
    harness.outbox.link_changed(True)
    harness.rounds()
    (told,) = harness.link.events(EventKind.BUFFER_DROPPED)
    assert told.data == {"measurements": 2000 - left, "events": 0}
    assert (told.device, told.severity) == ("arm", "warning")
    harness.store.close()


def test_a_stuck_thread_uses_bounded_memory_and_counts_drops(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MAX_INCOMING", 10)
    for number in range(14):
        harness.event(str(number))
    harness.rounds()
    assert harness.kept(late=False) == [str(number) for number in range(4, 14)]
    harness.outbox.link_changed(True)
    harness.rounds(4)
    (told,) = harness.link.events(EventKind.BUFFER_DROPPED)
    assert told.data["events"] == 4


class TestFullDisk:
    @pytest.fixture
    def full(self, harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
        """While its only entry is true, nothing can be put on disk."""
        put, full = harness.store.put, [True]

        def fail(items: Any, **options: Any) -> None:
            if full[0]:
                raise OutboxStoreError("outbox.db cannot be written: is the disk full?")
            put(items, **options)

        monkeypatch.setattr(harness.store, "put", fail)
        return full

    def test_events_go_out_from_memory_and_it_is_said(self, harness: DeviceHarness, full: list[bool]) -> None:
        assert full
        harness.outbox.link_changed(True)
        harness.event("held")
        harness.rounds(2)
        assert b"held" in harness.link.payloads(topics.EVENT)
        (told,) = harness.link.events(EventKind.BUFFER_FAILED)
        assert told.severity == "error"
        assert "disk full" in told.message
        harness.event("next")
        harness.rounds(40)
        assert harness.link.payloads(topics.EVENT).count(b"next") == 1
        assert len(harness.link.events(EventKind.BUFFER_FAILED)) == 1, "once"

    def test_events_wait_in_memory_for_the_disk_and_measurements_are_counted(
        self, harness: DeviceHarness, full: list[bool]
    ) -> None:
        harness.event("first")
        harness.measure(0, 5, sent=False)
        harness.rounds()
        full[0] = False
        harness.event("second")
        harness.rounds()
        assert harness.kept(late=False) == []
        harness.rounds(int(4 * module._SAVE_RETRY_S))
        assert harness.kept(late=False)[::2] == ["first", "second"], "with what was said of the disk between"
        harness.outbox.link_changed(True)
        harness.rounds(2)
        (told,) = harness.link.events(EventKind.BUFFER_DROPPED)
        assert told.data == {"measurements": 5, "events": 0}

    def test_memory_is_bounded(self, harness: DeviceHarness, full: list[bool]) -> None:
        assert full
        for number in range(module._MAX_UNSAVED + 20):
            harness.event(str(number))
        harness.rounds()
        assert len(harness.outbox._unsaved) == module._MAX_UNSAVED

    def test_what_is_only_in_memory_and_never_confirmed_is_let_go(
        self, harness: DeviceHarness, full: list[bool]
    ) -> None:
        assert full
        harness.link.confirms = False
        harness.outbox.link_changed(True)
        harness.event("refused")
        harness.rounds(int(4 * module._ACK_TIMEOUT_S * (module._MAX_ATTEMPTS + 1)))
        assert harness.link.payloads(topics.EVENT).count(b"refused") == module._MAX_ATTEMPTS
        assert harness.outbox._unsaved == {}


def test_an_unusable_folder_does_not_stop_the_outbox(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.path = tmp_path / "missing" / "outbox.db"
    harness.renew()
    harness.outbox.link_changed(True)
    harness.event("held")
    harness.rounds(2)
    assert b"held" in harness.link.payloads(topics.EVENT)
    harness.path.parent.mkdir()
    harness.rounds(int(4 * module._SAVE_RETRY_S) + 1)
    harness.event("again")
    harness.link.takes = False
    harness.rounds()
    assert harness.kept(late=False) == ["again"]
    harness.store.close()


def test_read_errors_are_reported_and_unexpected_errors_do_not_stop_the_thread(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    harness.outbox.link_changed(True)

    def fail(error: Exception) -> Callable[..., list[tuple[int, OutboxItem]]]:
        def after(*_: object, **__: object) -> list[tuple[int, OutboxItem]]:
            raise error

        return after

    with monkeypatch.context() as patch:
        patch.setattr(harness.store, "after", fail(OutboxStoreError("outbox.db cannot be read")))
        harness.event("one")
        harness.rounds()
    assert "cannot be read" in caplog.text
    with monkeypatch.context() as patch:
        patch.setattr(harness.store, "after", fail(RuntimeError("a mistake")))
        harness.rounds()
    assert "a mistake" in caplog.text
    harness.rounds(int(4 * module._SAVE_RETRY_S) + 1)
    assert b"one" in harness.link.payloads(topics.EVENT)


def test_the_thread_sends_at_once_and_drains_before_it_stops(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.outbox.start()
    harness.outbox.link_changed(True)
    harness.event("held")
    eventually(lambda: harness.link.payloads(topics.EVENT) == [b"held"])
    harness.link.confirms = False
    harness.event("goodbye")
    later = threading.Timer(0.1, harness.link.confirm)
    later.start()
    harness.outbox.stop()
    harness.outbox.stop()
    later.join()
    assert harness.link.payloads(topics.EVENT) == [b"held", b"goodbye"]
    harness.renew()
    harness.store.open()
    harness.event("x")
    harness.rounds()
    assert harness.kept(late=False)[-1] == "x"
    harness.store.close()
