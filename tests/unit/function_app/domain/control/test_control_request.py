"""Requests for control have exactly one outcome, and every change causes its events."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.domain.control import control_request, lease
from function_app.domain.control.control_events import ControlEvent, Fact, control_ended, lease_changes, timed_out
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity

ANNA, BERT, CLEO = (Identity(name[0], name, f"session of {name}") for name in ("anna", "bert", "cleo"))
START = 1_000_000
HELD = lease.acquire(None, ANNA, lease_ms=60_000, now_ms=START, pairing="p")


def request_control(known: Lease | None, who: Identity = BERT, *, now_ms: int = START, request: str = "r1") -> Lease:
    return control_request.request_control(
        known, who, request=request, within_ms=10_000, lease_ms=20_000, now_ms=now_ms
    )


def facts_of(before: Lease | None, after: Lease, now_ms: int = START) -> list[Fact]:
    return [event.fact for event in lease_changes(before, after, by="dora", now_ms=now_ms)]


def outcome(known: Lease, now_ms: int) -> str:
    assert known.request is not None
    return known.request.current_outcome(known, now_ms)


def test_a_request_ends_with_its_time_or_its_lease() -> None:
    requested = request_control(HELD)
    assert (outcome(requested, START + 9_999), outcome(requested, START + 10_000)) == ("open", "expired")
    assert control_request.withdraw(requested, BERT, request="r1", now_ms=START + 10_000) is requested
    short = lease.renew(HELD, ANNA, epoch=1, lease_ms=5_000, now_ms=START)
    assert outcome(request_control(short), START + 5_000) == "ended"
    accepted = control_request.accept(requested, ANNA, request="r1", now_ms=START)
    with pytest.raises(Problem, match="requester has control"):
        control_request.withdraw(accepted, BERT, request="r1", now_ms=START)


@pytest.mark.parametrize(
    ("before", "after", "facts"),
    [
        (None, HELD, [Fact.TAKEN]),
        (HELD, request_control(HELD), [Fact.REQUESTED]),
        (HELD, lease.renew(HELD, ANNA, epoch=1, lease_ms=9_000, now_ms=START), []),
        (HELD, lease.release(HELD, now_ms=START), [Fact.RELEASED]),
        (HELD, lease.acquire(HELD, ANNA, lease_ms=1_000, now_ms=START), [Fact.TAKEN]),
        (HELD, lease.acquire(HELD, BERT, lease_ms=1_000, now_ms=START, over="now"), [Fact.TAKEN_OVER]),
        (HELD, lease.invalidate(HELD, pairing="p", now_ms=START), [Fact.RESET_ORDERED]),
        (None, lease.invalidate(None, pairing="p", now_ms=START), [Fact.RESET_ORDERED]),
        (
            request_control(HELD),
            control_request.refuse(request_control(HELD), ANNA, request="r1", now_ms=START),
            [Fact.REQUEST_DENIED],
        ),
        (
            request_control(HELD),
            control_request.withdraw(request_control(HELD), BERT, request="r1", now_ms=START),
            [Fact.REQUEST_WITHDRAWN],
        ),
        (replace(HELD, action="x"), lease.release(replace(HELD, action="x"), now_ms=START), []),
    ],
)
def test_each_change_has_its_events(before: Lease | None, after: Lease, facts: list[Fact]) -> None:
    assert facts_of(before, after) == facts


def test_timeouts_are_recorded_with_the_next_change_and_their_own_time() -> None:
    asked = request_control(HELD)
    late = START + 60_000
    taken = lease.acquire(asked, CLEO, lease_ms=1_000, now_ms=late)
    assert facts_of(asked, taken, late) == [Fact.REQUEST_EXPIRED, Fact.EXPIRED, Fact.TAKEN]
    lapsed, expired, _ = lease_changes(asked, taken, by="cleo", now_ms=late)
    assert (lapsed.at_ms, expired.at_ms) == (START + 10_000, START + 60_000)
    assert list(timed_out(asked, late)) == [lapsed, expired], "the timer creates the same event"
    assert list(timed_out(None, late)) == list(timed_out(taken, late)) == []
    second = request_control(asked, CLEO, now_ms=START + 10_000, request="r2")
    assert facts_of(asked, second, START + 10_000) == [Fact.REQUEST_EXPIRED, Fact.REQUESTED]


def test_an_event_names_the_former_holder() -> None:
    over = lease.acquire(HELD, BERT, lease_ms=1_000, now_ms=START, over="needed")
    (told,) = lease_changes(HELD, over, by="bert", now_ms=START)
    assert told.data == {"epoch": 2, "holder": "bert", "from": "anna", "reason": "needed"}
    assert told.event("arm") | {"data": {}} == {
        "id": "control-taken-over-2",
        "device": "arm",
        "at_ms": START,
        "kind": "control-taken-over",
        "severity": "warning",
        "message": "bert took control from anna: needed",
        "data": {},
    }
    left = control_ended(HELD, Lease(epoch=2), why="moved", now_ms=START)
    assert (left.fact, left.data) == (Fact.ENDED, {"epoch": 2, "holder": "anna", "reason": "moved"})


Step = tuple[str, Identity, int]
STEPS = ("take", "over", "renew", "release", "reset", "ask", "accept", "refuse", "withdraw")


def act(what: str, known: Lease | None, who: Identity, *, now_ms: int, request_id: str) -> Lease:
    request = known.request.id if known is not None and known.request is not None else "none"
    epoch = known.epoch if known is not None else 1
    match what:
        case "take" | "over":
            over = "why" if what == "over" else ""
            after = lease.acquire(known, who, lease_ms=20_000, now_ms=now_ms, pairing="p", over=over)
        case "renew":
            after = lease.renew(known, who, epoch=epoch, lease_ms=20_000, now_ms=now_ms)
        case "release":
            after = lease.release(lease.require_held(known, who, epoch=epoch, now_ms=now_ms), now_ms=now_ms)
        case "reset":
            after = lease.invalidate(known, pairing="p", now_ms=now_ms)
        case "ask":
            after = request_control(known, who, now_ms=now_ms, request=request_id)
        case "accept":
            after = control_request.accept(known, who, request=request, now_ms=now_ms)
        case "refuse":
            after = control_request.refuse(known, who, request=request, now_ms=now_ms)
        case _:
            after = control_request.withdraw(known, who, request=request, now_ms=now_ms)
    return after


@given(
    st.lists(
        st.tuples(st.sampled_from(STEPS), st.sampled_from((ANNA, BERT, CLEO)), st.integers(0, 15_000)), max_size=30
    )
)
def test_requests_have_one_outcome_and_control_passes_only_by_consent(steps: list[Step]) -> None:
    known: Lease | None = None
    now_ms, number = START, 0
    told: list[ControlEvent] = []
    ends: dict[str, str] = {}
    for what, who, later_ms in steps:
        now_ms += later_ms
        number += 1
        before = known
        try:
            known = act(what, before, who, now_ms=now_ms, request_id=f"r{number}")
        except Problem:
            continue
        if known is not before:
            told += lease_changes(before, known, by=who.name, now_ms=now_ms)
        _check_step(before, known, what, who, now_ms)
        if known.request is not None and (end := known.request.current_outcome(known, now_ms)) != "open":
            assert ends.setdefault(known.request.id, end) == end, "it had another outcome before"
    ids = [event.id for event in told]
    assert len(ids) == len(set(ids)), "an event was created twice"
    assert not [each for each in told if each.fact is Fact.HANDED_OVER and ends[each.data["request"]] != "accepted"]


def _check_step(before: Lease | None, after: Lease, what: str, who: Identity, now_ms: int) -> None:
    if before is None:
        return
    assert after.epoch - before.epoch in {0, 1}
    passed = (
        before.is_live(now_ms) and after.account and (after.account, after.session) != (before.account, before.session)
    )
    if passed:
        assert after.epoch == before.epoch + 1, "fenced"
        assert what == "over" or (what == "accept" and before.held_by(who)), "only the holder or an owner passes it on"
    if what in {"ask", "refuse", "withdraw"}:
        assert replace(after, request=None) == replace(before, request=None)
