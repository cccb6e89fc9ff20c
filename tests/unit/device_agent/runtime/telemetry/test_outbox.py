"""Outbox: no event is lost, callers never wait, and live messages have priority."""

import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from device_agent.protocol.events import EventKind
from device_agent.runtime.storage.outbox_store import OutboxItem
from device_agent.runtime.telemetry import outbox as module
from device_agent.runtime.telemetry.outbox import BUSY_RATE_HZ, RATE_HZ, _Flight
from tests.harness.agent.device_harness import WITHIN_S, eventually
from tests.unit.device_agent.runtime.telemetry.outbox_fixture import ARM, LATE, OutboxFixture, fail


@pytest.fixture
def fixture(tmp_path: Path) -> Iterator[OutboxFixture]:
    fixture = OutboxFixture(tmp_path)
    yield fixture
    fixture.store.close()


def test_an_event_is_stored_before_it_is_sent_and_deleted_after_the_ack(fixture: OutboxFixture) -> None:
    fixture.connect()
    fixture.acknowledges = False
    fixture.event("held")
    fixture.iterate()
    assert fixture.events() == fixture.stored() == ["held"]
    fixture.iterate(3)
    assert fixture.events() == ["held"], "it is in flight"
    fixture.acknowledge()
    fixture.iterate()
    assert fixture.stored() == []


def test_unacknowledged_messages_are_resent_in_order_after_a_lost_link(fixture: OutboxFixture) -> None:
    fixture.connect()
    fixture.acknowledges = False
    fixture.event("one", "two", "three")
    fixture.iterate()
    fixture.open.pop(0)()
    fixture.outbox.link_changed(False)
    fixture.iterate()
    fixture.sent.clear()
    fixture.acknowledges = True
    fixture.connect()
    fixture.iterate(2)
    assert fixture.events() == ["two", "three"]
    assert fixture.stored() == []


def test_stored_messages_are_sent_after_a_restart(fixture: OutboxFixture) -> None:
    fixture.event("before")
    fixture.measure(0, 3)
    fixture.iterate()
    fixture.store.close()
    fixture.restart()
    fixture.connect()
    fixture.iterate(4)
    assert [payload for _, payload in fixture.sent] == [b"before", b"0", b"1", b"2"], "events first"


def test_measurements_are_stored_at_a_reduced_rate_from_shortly_before_the_link_was_lost(
    fixture: OutboxFixture,
) -> None:
    fixture.connect()
    fixture.measure(0, 30, sent=True)
    fixture.iterate()
    assert fixture.stored(late=True) == []
    fixture.outbox.link_changed(False)
    fixture.measure(30, 32)
    fixture.iterate()
    assert fixture.stored(late=True) == [str(number) for number in range(19, 32)], "the last ten seconds, in order"
    fixture.measure(1000, 2000, each_s=0.02)
    fixture.iterate()
    assert 13 + 19 <= len(fixture.stored(late=True)) <= 13 + 21, "one a second of twenty seconds"


def test_each_stream_has_its_own_rate_and_is_stored_once_per_lost_link(fixture: OutboxFixture) -> None:
    fixture.connect()
    for topic, payload in ((LATE, b"first"), (ARM + "/late/heat", b"second"), (LATE, b"too early")):
        fixture.outbox.add_measurement(topic, payload, at_ms=1, sent=True, now_s=fixture.now_s)
    for _ in range(2):
        fixture.outbox.link_changed(False)
        fixture.iterate()
        assert fixture.stored(late=True) == ["first", "second"]


def test_the_send_rate_is_low_and_lower_during_motion(fixture: OutboxFixture) -> None:
    fixture.measure(0, 500)
    fixture.iterate()
    fixture.connect()
    fixture.iterate_for(1)
    assert len(fixture.sent) <= module._WINDOW + RATE_HZ
    for fixture.quiet, rate_hz in ((True, RATE_HZ), (False, BUSY_RATE_HZ)):
        before = len(fixture.sent)
        fixture.iterate_for(10)
        assert 9 * rate_hz <= len(fixture.sent) - before <= 11 * rate_hz
    assert [payload for _, payload in fixture.sent] == [str(number).encode() for number in range(len(fixture.sent))]


def test_messages_in_flight_are_limited_and_a_full_link_queue_is_retried(fixture: OutboxFixture) -> None:
    fixture.measure(0, 100)
    fixture.acknowledges = fixture.accepts = False
    fixture.connect()
    fixture.iterate(3)
    fixture.accepts = True
    fixture.iterate(4)
    assert len(fixture.sent) == module._WINDOW
    fixture.acknowledge()
    fixture.iterate(4)
    assert len(fixture.sent) == 2 * module._WINDOW


@pytest.mark.parametrize("disk_full", [False, True])
def test_an_undelivered_message_is_repeated_after_growing_pauses_and_never_dropped(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch, disk_full: bool
) -> None:
    if disk_full:
        monkeypatch.setattr(fixture.store, "put", fail)
    fixture.connect()
    fixture.acknowledges = False
    fixture.event("held")
    sent_s = []
    for _ in range(4 * 60):
        before = fixture.events().count("held")
        fixture.iterate()
        sent_s += [fixture.now_s] * (fixture.events().count("held") - before)
    pauses_s = [later - sooner for sooner, later in pairwise(sent_s)]
    assert pauses_s == [1.0, 2.0, 4.0, 8.0, 8.0, 8.0, 8.0, 8.0, 8.0]
    fixture.acknowledge()
    fixture.iterate()
    assert (fixture.stored(), fixture.outbox._unsaved, fixture.outbox._in_flight) == ([], {}, {})


def test_a_new_event_is_sent_at_once_while_many_messages_are_undelivered(fixture: OutboxFixture) -> None:
    fixture.connect()
    fixture.acknowledges = False
    fixture.event(*map(str, range(100)))
    fixture.measure(0, 1000, each_s=0.0)
    fixture.iterate_for(60)
    assert len({payload for topic, payload in fixture.sent if topic == LATE}) <= module._MAX_LATE
    for number in range(5):
        fixture.event(f"new {number}")
        fixture.iterate(4)
        assert f"new {number}" in fixture.events(), "within a second"
    assert len(fixture.sent) <= 11 * 66, "and not more than ten messages a second"


def test_undelivered_measurements_are_repeated_and_bounded(fixture: OutboxFixture) -> None:
    fixture.measure(0, 1000)
    fixture.connect()
    fixture.acknowledges = False
    fixture.iterate_for(120)
    assert {payload for _, payload in fixture.sent} == {str(number).encode() for number in range(module._MAX_LATE)}
    assert len(fixture.sent) > 2 * module._MAX_LATE
    fixture.acknowledges = True
    fixture.acknowledge()
    fixture.iterate_for(1)
    assert len({payload for _, payload in fixture.sent}) > module._MAX_LATE


def test_a_dropped_message_is_not_repeated(fixture: OutboxFixture) -> None:
    fixture.connect()
    fixture.acknowledges = False
    fixture.event("old")
    fixture.iterate()
    fixture.store.remove([number for number, _ in fixture.store.after(0, late=False, limit=1)])
    fixture.iterate_for(10)
    assert fixture.events() == ["old"]
    assert fixture.outbox._in_flight == {}


def test_dropped_messages_are_reported_after_reconnection(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "wall_ms", lambda: 7_000)
    fixture.restart(max_bytes=50_000)
    fixture.measure(0, 2000)
    fixture.iterate()
    left = len(fixture.stored(late=True))
    fixture.connect()
    fixture.iterate()
    (report,) = fixture.reports(EventKind.BUFFER_DROPPED)
    assert report.data == {"measurements": 2000 - left, "events": 0}
    assert (report.device, report.severity, report.at_ms) == ("arm", "warning", 7_000)


def test_a_stuck_thread_uses_bounded_memory_and_counts_drops(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MAX_INCOMING", 10)
    fixture.event(*map(str, range(14)))
    fixture.iterate()
    assert fixture.stored() == [str(number) for number in range(4, 14)]
    fixture.connect()
    fixture.iterate(4)
    (report,) = fixture.reports(EventKind.BUFFER_DROPPED)
    assert report.data["events"] == 4


def test_the_thread_sends_at_once_and_drains_before_it_stops(fixture: OutboxFixture) -> None:
    fixture.outbox.start()
    fixture.connect()
    fixture.event("held")
    eventually(lambda: fixture.events() == ["held"])
    fixture.acknowledges = False
    fixture.event("last")
    later = threading.Timer(0.1, fixture.acknowledge)
    later.start()
    fixture.outbox.stop()
    fixture.outbox.stop()
    later.join()
    assert fixture.events() == ["held", "last"]
    fixture.restart()
    fixture.event("last")
    fixture.iterate()
    assert fixture.stored() == ["last"]


def test_an_idle_thread_stops_at_once(fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PERIOD_S", 10.0)
    fixture.outbox.start()
    fixture.event("held")
    eventually(lambda: fixture.outbox.stored_bytes)
    fixture.outbox.stop()
    assert not fixture.outbox._thread.is_alive()


def test_a_hanging_disk_does_not_delay_the_stop(fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_STOP_S", 0.01)
    hangs, released = threading.Event(), threading.Event()

    def hang() -> None:
        hangs.set()
        released.wait()

    monkeypatch.setattr(fixture.store, "open", hang)
    fixture.outbox.start()
    assert hangs.wait(WITHIN_S)
    fixture.outbox.stop()
    assert fixture.outbox._thread.is_alive()
    released.set()
    fixture.outbox._thread.join(WITHIN_S)


def test_on_a_new_link_no_message_is_in_flight_and_the_bounds_are_checked(
    fixture: OutboxFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fixture.acknowledges = False
    fixture.connect()
    fixture.event("a")
    fixture.iterate()
    assert fixture.outbox._in_flight
    checks: list[int] = []
    monkeypatch.setattr(fixture.store, "enforce_bounds", lambda *, now_ms: checks.append(now_ms))
    fixture.accepts = False
    fixture.outbox.link_changed(False)
    fixture.connect()
    fixture.iterate()
    assert not fixture.outbox._in_flight
    assert checks


def test_never_more_messages_are_taken_than_the_limit(fixture: OutboxFixture) -> None:
    fixture.event("a", "b")
    fixture.measure(0, 5)
    fixture.iterate()
    item = OutboxItem(ARM + "/event", b"c", 1, late=False)
    for unsaved in ({}, {-1: item, -2: item}):
        fixture.outbox._unsaved = dict(unsaved)
        assert [len(fixture.outbox._next(fixture.now_s, limit)) for limit in range(4)] == [0, 1, 2, 3]


def test_the_message_that_has_waited_longest_is_repeated_first(fixture: OutboxFixture) -> None:
    item = OutboxItem(ARM + "/event", b"c", 1, late=False)
    fixture.outbox._unsaved = {-2: item, -1: item}
    fixture.outbox._in_flight = {
        -2: _Flight(late=False, sent_s=9.0, pause_s=1.0),
        -1: _Flight(late=False, sent_s=5.0, pause_s=1.0),
    }
    due = [[number for number, _ in fixture.outbox._due(fixture.now_s, limit)] for limit in range(3)]
    assert due == [[], [-1], [-1, -2]]


def test_measurements_are_stored_at_the_configured_rate(fixture: OutboxFixture) -> None:
    fixture.restart(keep_hz=2.0)
    fixture.measure(0, 8, each_s=0.25)
    fixture.iterate()
    assert fixture.stored(late=True) == ["0", "2", "4", "6"]
