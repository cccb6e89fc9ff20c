"""Control events: id, time and data for each change of a lease or request."""

from dataclasses import replace
from typing import Any

import pytest

from function_app.domain.control import control_request, lease
from function_app.domain.control.control_events import ControlEvent, Fact, control_ended, lease_changes, timed_out
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity

ANNA, BERT = Identity("a", "anna", "s1"), Identity("b", "bert", "s2")
NOW = 1_000_000
HELD = lease.acquire(None, ANNA, lease_ms=60_000, now_ms=NOW, pairing="p")
REQUESTED = control_request.request_control(HELD, BERT, request="r", within_ms=10_000, lease_ms=20_000, now_ms=NOW)
OPEN = {"request": "r", "requester": "bert", "epoch": 1}
ACCEPTED = control_request.accept(REQUESTED, ANNA, request="r", now_ms=NOW)
TAKEN_OVER = lease.acquire(HELD, BERT, lease_ms=1_000, now_ms=NOW, over="fire")


def facts(before: Lease | None, after: Lease, now_ms: int = NOW) -> list[tuple[str, int, dict[str, Any], str]]:
    events = list(lease_changes(before, after, by="dora", now_ms=now_ms))
    assert all(event.id.startswith(event.fact.value) and len(event.message) > 10 for event in events)
    return [(event.id, event.at_ms, event.data, event.severity) for event in events]


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (None, HELD, ("control-taken-1", {"epoch": 1, "holder": "anna"}, "info")),
        (None, replace(HELD, action="x"), ("control-taken-1", {"epoch": 1, "holder": "anna", "action": "x"}, "info")),
        (
            HELD,
            TAKEN_OVER,
            ("control-taken-over-2", {"epoch": 2, "holder": "bert", "from": "anna", "reason": "fire"}, "warning"),
        ),
        (HELD, lease.release(HELD, now_ms=NOW), ("control-released-1", {"epoch": 1, "holder": "anna"}, "info")),
        (
            HELD,
            lease.invalidate(HELD, pairing="p", now_ms=NOW),
            (
                "stop-reset-ordered-2",
                {"epoch": 2, "caller": "dora", "holder": "", "from": "anna", "ended_epoch": 1},
                "info",
            ),
        ),
        (
            REQUESTED,
            ACCEPTED,
            ("control-handed-over-2", {"epoch": 2, "request": "r", "holder": "bert", "from": "anna"}, "info"),
        ),
        (HELD, REQUESTED, ("control-requested-r", OPEN, "info")),
        (
            REQUESTED,
            control_request.reject(REQUESTED, ANNA, request="r", now_ms=NOW),
            ("control-request-denied-r", OPEN, "info"),
        ),
        (
            REQUESTED,
            control_request.withdraw(REQUESTED, BERT, request="r", now_ms=NOW),
            ("control-request-withdrawn-r", OPEN, "info"),
        ),
    ],
)
def test_a_change_is_one_event(before: Lease | None, after: Lease, expected: tuple[str, dict[str, Any], str]) -> None:
    name, data, severity = expected
    assert facts(before, after) == [(name, NOW, data, severity)]


def test_a_rejection_names_both_accounts() -> None:
    rejected = control_request.reject(REQUESTED, ANNA, request="r", now_ms=NOW)
    (event,) = lease_changes(REQUESTED, rejected, by="dora", now_ms=NOW)
    assert event.message == "dora rejected the request of bert for control."


def test_only_a_lease_without_an_action_ends_with_a_release_event() -> None:
    held = replace(HELD, action="x")
    assert facts(held, lease.release(held, now_ms=NOW)) == []
    assert facts(HELD, replace(HELD, expires_ms=NOW + 90_000)) == []


def test_timeouts_before_a_change_are_recorded_with_their_own_time() -> None:
    expired = ("control-expired-1", NOW + 60_000, {"epoch": 1, "holder": "anna"}, "info")
    unanswered = ("control-request-expired-r", NOW + 10_000, OPEN, "info")
    now_ms = NOW + 70_000
    taken = lease.acquire(REQUESTED, BERT, lease_ms=1_000, now_ms=now_ms, pairing="p")
    assert facts(REQUESTED, taken, now_ms) == [
        unanswered,
        expired,
        ("control-taken-2", now_ms, {"epoch": 2, "holder": "bert"}, "info"),
    ]
    assert facts(HELD, lease.release(HELD, now_ms=now_ms), now_ms) == [expired]
    reset = ("stop-reset-ordered-2", now_ms, {"epoch": 2, "caller": "dora", "holder": ""}, "info")
    assert facts(HELD, lease.invalidate(HELD, pairing="p", now_ms=now_ms), now_ms) == [expired, reset]
    assert [event.id for event in timed_out(replace(REQUESTED, action="x"), now_ms)] == ["control-request-expired-r"]
    assert list(timed_out(REQUESTED, NOW + 9_999)) == []
    assert list(timed_out(Lease(epoch=1), now_ms)) == []


def test_a_new_request_records_the_timeout_of_the_previous_one_but_not_of_the_lease() -> None:
    now_ms = NOW + 10_000
    again = control_request.request_control(
        REQUESTED, BERT, request="r2", within_ms=10_000, lease_ms=20_000, now_ms=now_ms
    )
    assert [name for name, *_ in facts(REQUESTED, again, now_ms)] == [
        "control-request-expired-r",
        "control-requested-r2",
    ]
    assert [name for name, *_ in facts(REQUESTED, replace(REQUESTED, request=None), NOW + 70_000)] == [
        "control-request-expired-r"
    ]
    assert facts(REQUESTED, replace(REQUESTED, expires_ms=NOW + 90_000), now_ms) == []


@pytest.mark.parametrize(("why", "text"), [("unshared", "is no longer shared"), ("moved", "was moved")])
def test_control_that_ended_with_the_permission_names_the_reason(why: str, text: str) -> None:
    event = control_ended(HELD, Lease(epoch=2), why=why, now_ms=NOW)
    assert (event.id, event.fact, event.at_ms, event.severity) == ("control-ended-2", Fact.ENDED, NOW, "info")
    assert event.data == {"epoch": 2, "holder": "anna", "reason": why, "ended_epoch": 1}
    assert text in event.message
    assert "anna" in event.message


def test_an_event_is_stored_with_all_its_fields() -> None:
    event = ControlEvent("id", Fact.TAKEN, 5, "text", {"epoch": 1}, "warning")
    stored = {"id": "id", "at_ms": 5, "kind": "control-taken", "message": "text", "data": {"epoch": 1}}
    assert event.event("arm") == {**stored, "device": "arm", "severity": "warning"}
