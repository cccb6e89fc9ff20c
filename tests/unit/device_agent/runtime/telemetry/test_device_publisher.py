"""Acks are repeated until they are delivered."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from device_agent.protocol import Ack, AckStatus, Event, Reason, codec
from device_agent.protocol.events import EventKind
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.storage.journal import Journal, JournalError
from device_agent.runtime.telemetry import device_publisher as module
from device_agent.runtime.telemetry.device_publisher import DevicePublisher
from tests.fakes.drivers import robot_type
from tests.fakes.tracing import TRACEPARENT


class PublisherFixture:
    """A publisher on a manual clock, whose acks are delivered on request."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.journal = Journal(folder / "journal.db")
        self.journal.open(now_ms=0)
        self.sent: list[tuple[float, str]] = []
        self.acks: list[Ack] = []
        self.delivered: dict[str, Callable[[], None]] = {}
        self.steps: list[tuple[str, AckStatus, Reason | None]] = []
        self.ended: list[str] = []
        self.recorded: list[Event] = []
        self.publisher = DevicePublisher(
            address=("s", "a", "arm"),
            label="Arm",
            robot_type=robot_type(),
            simulated=True,
            limits=(),
            actions=(),
            interlocks=(),
            streaming=True,
            journal=self.journal,
            publish=self.publish,
            outbox=cast("Any", None),
            traces=cast("Any", self),
            record_event=self.recorded.append,
        )

    def step(self, command: str, status: AckStatus, reason: Reason | None) -> str:
        self.steps.append((command, status, reason))
        return TRACEPARENT

    def end(self, command: str) -> None:
        self.ended.append(command)

    def publish(self, topic: str, payload: bytes, *, delivered: Callable[[], None] | None = None, **more: Any) -> bool:
        if topic.endswith("/ack"):
            assert (topic, more) == ("ts/v1/s/a/arm/ack", {"qos": 1})
            assert delivered is not None
            ack = codec.decode(payload, Ack)
            self.sent.append((self.now_s, ack.id))
            self.acks.append(ack)
            self.delivered[ack.id] = delivered
        return True

    def command(self, name: str) -> None:
        self.journal.begin("arm", self.publisher.create_ack(name, AckStatus.RECEIVED), issued_ms=1)
        self.publisher.report(name, AckStatus.DONE)

    def run(self, seconds: float) -> None:
        for _ in range(round(4 * seconds)):
            self.now_s += 0.25
            self.publisher.update_journal()
            self.publisher.repeat_acks()

    def times(self, name: str) -> list[float]:
        return [at_s for at_s, sent in self.sent if sent == name]


@pytest.fixture
def fixture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PublisherFixture]:
    fixture = PublisherFixture(tmp_path, monkeypatch)
    yield fixture
    fixture.journal.close()


def pauses(times: list[float]) -> list[float]:
    return [later - sooner for sooner, later in pairwise(times)]


def test_acks_have_their_sequence_reason_and_trace(fixture: PublisherFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "wall_ms", lambda: 2000)
    monkeypatch.setattr(module, "tick_ms", lambda: 30)
    reason = Reason(code="stopped", message="stop")
    common: dict[str, Any] = {"id": "c1", "at_ms": 2000, "tick_ms": 30, "traceparent": TRACEPARENT}
    received = fixture.publisher.create_ack("c1", AckStatus.RECEIVED)
    assert received == Ack(status=AckStatus.RECEIVED, sequence=1, **common)
    fixture.journal.begin("arm", received, issued_ms=1)
    for status, sequence, fields in (
        (AckStatus.STARTED, 2, {"progress": 0.5}),
        (AckStatus.FAILED, 3, {"reason": reason}),
    ):
        fixture.publisher.report("c1", status, **fields)
        expected = Ack(status=status, sequence=sequence, **fields, **common)
        assert fixture.acks[-1] == expected
        assert list(fixture.journal.undelivered("arm").values()) == [expected]
        assert fixture.ended == (["c1"] if status.terminal else [])
    assert fixture.steps[-1] == ("c1", AckStatus.FAILED, reason)
    for command in ("c1", "c2"):
        assert fixture.publisher.create_ack(command, AckStatus.FAILED).sequence == 1, "none before, or ended"


def test_an_event_of_an_ack_is_recorded_for_the_device(fixture: PublisherFixture) -> None:
    fixture.journal.begin("arm", fixture.publisher.create_ack("c1", AckStatus.RECEIVED), issued_ms=1)
    event = EventRecord(EventKind.STOP_RESET, "on", "info", {}, 7)
    fixture.publisher.report("c1", AckStatus.STARTED, recorded=event)
    assert [(each.device, each.kind, each.at_ms) for each in fixture.recorded] == [("arm", "stop-reset", 7)]


def test_the_pauses_grow_to_eight_seconds_and_the_repetition_ends_with_the_delivery(fixture: PublisherFixture) -> None:
    fixture.command("c1")
    fixture.run(40)
    first, *others = pauses(fixture.times("c1"))
    assert first == pytest.approx(1.0, abs=0.3), "checks are periodic"
    assert others == [1.0, 2.0, 4.0, 8.0, 8.0, 8.0]
    fixture.delivered["c1"]()
    sent = len(fixture.sent)
    fixture.run(40)
    assert len(fixture.sent) == sent


def test_a_new_ack_is_repeated_soon_although_older_ones_wait(fixture: PublisherFixture) -> None:
    fixture.command("old")
    fixture.run(30)
    fixture.command("new")
    fixture.run(1.5)
    assert len(fixture.times("new")) == 2


def test_acks_are_sent_at_once_on_reconnection(fixture: PublisherFixture) -> None:
    fixture.command("c1")
    fixture.run(20)
    fixture.publisher.publish_description(None)
    fixture.run(0.25)
    assert fixture.times("c1")[-1] == fixture.now_s


def test_many_acks_are_repeated_in_parts_of_bounded_size(fixture: PublisherFixture) -> None:
    count = 2 * module._MAX_REPEATED + 7
    for number in range(count):
        fixture.command(f"c{number}")
    fixture.sent.clear()
    fixture.run(3.75)
    assert len(fixture.sent) == len({name for _, name in fixture.sent}) == count
    assert max(sum(at_s == other_s for other_s, _ in fixture.sent) for at_s, _ in fixture.sent) == module._MAX_REPEATED


def test_nothing_is_repeated_after_a_full_last_part(fixture: PublisherFixture) -> None:
    for number in range(module._MAX_REPEATED):
        fixture.command(f"c{number}")
    fixture.run(1.5)
    for delivered in fixture.delivered.values():
        delivered()
    sent = len(fixture.sent)
    fixture.run(20)
    assert len(fixture.sent) == sent
    assert fixture.publisher._repeat_s == float("inf")


def test_a_terminal_ack_is_sent_on_a_full_disk_and_journalled_later(
    fixture: PublisherFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixture.journal.begin("arm", fixture.publisher.create_ack("c1", AckStatus.RECEIVED), issued_ms=1)
    record = fixture.journal.record
    monkeypatch.setattr(fixture.journal, "record", Mock(side_effect=JournalError("is the disk full?")))
    with pytest.raises(JournalError):
        fixture.publisher.report("c1", AckStatus.STARTED)
    assert fixture.sent == []
    fixture.publisher.report("c1", AckStatus.DONE)
    assert [command for _, command in fixture.sent] == ["c1"]
    with pytest.raises(JournalError):
        fixture.publisher.update_journal()
    monkeypatch.setattr(fixture.journal, "record", record)
    fixture.publisher.update_journal()
    last = fixture.journal.begin("arm", fixture.publisher.create_ack("c1", AckStatus.RECEIVED), issued_ms=1)
    assert last is not None
    assert last.status is AckStatus.DONE
