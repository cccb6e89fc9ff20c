"""What happened is told once, in order; what happens again and again is counted."""

from device_agent.protocol.events import EventKind
from device_agent.runtime.authority import event_recorder as module
from device_agent.runtime.authority.event_recorder import GAP_S, EventRecord, EventRecorder, ignore_event


def refusal(message: str = "too late") -> EventRecord:
    return EventRecord(EventKind.SETPOINTS_REJECTED, message, "warning", {"code": "too_old"})


def test_events_are_drained_once_in_order_with_their_time() -> None:
    audit = EventRecorder()
    audit.record(EventRecord(EventKind.LEASE_GRANTED, "ann took control", at_ms=5))
    audit.record(EventRecord(EventKind.LEASE_ENDED, "ann let go"))
    first, second = audit.drain(0.0)
    assert (first.kind, first.at_ms) == (EventKind.LEASE_GRANTED, 5)
    assert second.kind is EventKind.LEASE_ENDED
    assert second.at_ms > 0
    assert audit.drain(100.0) == []


def test_repeated_rejections_are_counted() -> None:
    audit = EventRecorder()
    for _ in range(1000):
        audit.record_rejection(refusal(), code="too_old", now_s=10.0)
    (first,) = audit.drain(10.0)
    assert "count" not in first.data
    assert audit.drain(10.0 + GAP_S / 2) == []
    (rest,) = audit.drain(10.0 + GAP_S)
    assert rest.data == {"code": "too_old", "count": 999}
    assert audit.drain(10.0 + 2 * GAP_S) == [], "it is over"
    audit.record_rejection(refusal(), code="too_old", now_s=30.0)
    assert len(audit.drain(30.0)) == 1, "and a later one is told at once again"


def test_the_last_drain_returns_all_counts() -> None:
    audit = EventRecorder()
    audit.record_rejection(refusal(), code="too_old", now_s=10.0)
    audit.record_rejection(refusal("later"), code="too_old", now_s=10.1)
    first, last = audit.drain(float("inf"))
    assert (first.message, last.message, last.data["count"]) == ("too late", "later", 1)


def test_different_codes_are_counted_separately_up_to_a_bound() -> None:
    audit = EventRecorder()
    for number in range(module._MAX_COUNTED + 3):
        audit.record_rejection(refusal(), code=f"code{number}", now_s=0.0)
    told = audit.drain(0.0)
    assert len(told) == module._MAX_COUNTED + 1
    assert (told[-1].kind, told[-1].data) == (EventKind.EVENTS_DROPPED, {"count": 3})
    assert audit.drain(0.1) == []


def test_memory_is_bounded_without_drains() -> None:
    audit = EventRecorder()
    for _ in range(module._MAX_WAITING + 7):
        audit.record(EventRecord(EventKind.MOTION_HELD, "held"))
    told = audit.drain(0.0)
    assert len(told) == module._MAX_WAITING + 1
    assert told[-1].data == {"count": 7}


def test_events_can_be_ignored() -> None:
    ignore_event(refusal())
