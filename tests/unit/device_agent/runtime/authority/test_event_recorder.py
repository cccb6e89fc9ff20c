"""Event recorder: order, counts of repeated rejections and bounds."""

from device_agent.protocol.events import EventKind
from device_agent.runtime.authority import event_recorder as module
from device_agent.runtime.authority.event_recorder import GAP_S, EventRecord, EventRecorder, ignore_event


def refusal(message: str = "too late") -> EventRecord:
    return EventRecord(EventKind.SETPOINTS_REJECTED, message, "warning", {"code": "too_old"})


def test_events_are_drained_once_in_order_with_their_time() -> None:
    recorder = EventRecorder()
    recorder.record(EventRecord(EventKind.LEASE_GRANTED, "ann took control", at_ms=5))
    recorder.record(EventRecord(EventKind.LEASE_ENDED, "ann released control"))
    first, second = recorder.drain(0.0)
    assert (first.kind, first.at_ms) == (EventKind.LEASE_GRANTED, 5)
    assert second.kind is EventKind.LEASE_ENDED
    assert second.at_ms > 0
    assert recorder.drain(100.0) == []


def test_repeated_rejections_are_counted() -> None:
    recorder = EventRecorder()
    for _ in range(1000):
        recorder.record_rejection(refusal(), code="too_old", now_s=10.0)
    (first,) = recorder.drain(10.0)
    assert "count" not in first.data
    assert recorder.drain(10.0 + GAP_S / 2) == []
    (rest,) = recorder.drain(10.0 + GAP_S)
    assert rest.data == {"code": "too_old", "count": 999}
    assert recorder.drain(10.0 + 2 * GAP_S) == [], "it is over"
    recorder.record_rejection(refusal(), code="too_old", now_s=30.0)
    assert len(recorder.drain(30.0)) == 1, "and a later one is recorded immediately again"


def test_a_rejection_that_is_over_or_recent_does_not_hide_another() -> None:
    recorder = EventRecorder()
    for code, now_s in (("over", 0.0), ("recent", GAP_S), ("old", 0.0), ("old", 1.0)):
        recorder.record_rejection(refusal(), code=code, now_s=now_s)
    assert len(recorder.drain(GAP_S / 2)) == 3
    (counted,) = recorder.drain(GAP_S + 0.1)
    assert counted.data["count"] == 1


def test_the_last_drain_returns_all_counts() -> None:
    recorder = EventRecorder()
    recorder.record_rejection(refusal(), code="too_old", now_s=10.0)
    recorder.record_rejection(refusal("later"), code="too_old", now_s=10.1)
    first, last = recorder.drain(float("inf"))
    assert (first.message, last.message, last.data["count"]) == ("too late", "later", 1)


def test_memory_is_bounded_and_dropped_events_are_counted() -> None:
    recorder = EventRecorder()
    for number in range(module._MAX_COUNTED + 3):
        recorder.record_rejection(refusal(), code=f"code{number}", now_s=0.0)
    *events, dropped = recorder.drain(0.0)
    assert len(events) == module._MAX_COUNTED
    assert (dropped.kind, dropped.severity, dropped.data) == (EventKind.EVENTS_DROPPED, "warning", {"count": 3})
    assert dropped.message.startswith("3 events were not recorded individually")
    assert recorder.drain(0.1) == []
    for _ in range(module._MAX_WAITING + 7):
        recorder.record(EventRecord(EventKind.MOTION_HELD, "held"))
    *events, dropped = recorder.drain(0.0)
    assert (len(events), dropped.data) == (module._MAX_WAITING, {"count": 7})


def test_events_can_be_ignored() -> None:
    ignore_event(refusal())
