"""Requests for control have exactly one outcome, and every change causes its events."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.domain.control import control_request, lease
from function_app.domain.control.control_events import ControlEvent, Fact, control_ended, lease_changes, timed_out
from function_app.domain.control.lease import ControlRequest, Lease
from function_app.domain.identity.accounts import Identity

ANNA, BERT, CLEO = (Identity(name[0], name, f"session of {name}") for name in ("anna", "bert", "cleo"))
START = 1_000_000
HELD = lease.acquire(None, ANNA, lease_ms=60_000, now_ms=START, pairing="p")


def request_control(
    current: Lease | None, caller: Identity = BERT, *, now_ms: int = START, request: str = "r1"
) -> Lease:
    return control_request.request_control(
        current, caller, request=request, within_ms=10_000, lease_ms=20_000, now_ms=now_ms
    )


def facts_of(before: Lease | None, after: Lease, now_ms: int = START) -> list[Fact]:
    return [event.fact for event in lease_changes(before, after, by="dora", now_ms=now_ms)]


def outcome(current: Lease, now_ms: int) -> str:
    assert current.request is not None
    return current.request.current_outcome(current, now_ms)


def test_a_request_ends_with_its_time_or_its_lease() -> None:
    requested = request_control(HELD)
    assert (outcome(requested, START + 9_999), outcome(requested, START + 10_000)) == ("open", "expired")
    assert control_request.withdraw(requested, BERT, request="r1", now_ms=START + 10_000) is requested
    short = lease.renew(HELD, ANNA, epoch=1, lease_ms=5_000, now_ms=START)
    assert outcome(request_control(short), START + 5_000) == "ended"
    accepted = control_request.accept(requested, ANNA, request="r1", now_ms=START)
    assert control_request.accept(accepted, ANNA, request="r1", now_ms=START) is accepted
    rejected = control_request.reject(requested, ANNA, request="r1", now_ms=START)
    assert control_request.reject(rejected, ANNA, request="r1", now_ms=START) is rejected
    with pytest.raises(Problem, match="requester has control"):
        control_request.withdraw(accepted, BERT, request="r1", now_ms=START)


def test_only_an_accepted_request_changes_the_holder() -> None:
    requested = request_control(HELD)
    sent = ControlRequest(
        id="r1",
        epoch=1,
        account="b",
        session="session of bert",
        by="bert",
        holder_account="a",
        holder_session="session of anna",
        requested_ms=START,
        expires_ms=START + 10_000,
        lease_ms=20_000,
    )
    assert requested == replace(HELD, request=sent)
    assert request_control(requested) is requested
    at: Any = {"request": "r1", "now_ms": START + 1}
    rejected = control_request.reject(requested, ANNA, **at)
    assert rejected == replace(HELD, request=replace(sent, outcome="rejected"))
    withdrawn = control_request.withdraw(requested, BERT, **at)
    assert withdrawn == replace(HELD, request=replace(sent, outcome="withdrawn"))
    assert control_request.accept(requested, ANNA, **at) == Lease(
        epoch=2,
        account="b",
        session="session of bert",
        holder="bert",
        expires_ms=START + 20_001,
        lease_ms=20_000,
        pairing="p",
        request=replace(sent, outcome="accepted"),
    )


@pytest.mark.parametrize(
    ("current", "caller", "code", "extras"),
    [
        (None, BERT, "lease-free", {}),
        (Lease(epoch=1), BERT, "lease-free", {}),
        (HELD, ANNA, "lease-already-held", {"epoch": 1}),
        (
            request_control(HELD),
            CLEO,
            "lease-requested",
            {"requester": "bert", "expires_at": "1970-01-01T00:16:50.000Z"},
        ),
    ],
)
def test_a_request_is_refused(current: Lease | None, caller: Identity, code: str, extras: dict[str, object]) -> None:
    with pytest.raises(Problem) as problem:
        request_control(current, caller)
    assert (problem.value.code, problem.value.status, problem.value.extras) == (code, 409, extras)


@pytest.mark.parametrize(
    ("answer", "caller", "request_id", "code", "status"),
    [
        (control_request.accept, ANNA, "r2", "request-unknown", 404),
        (control_request.accept, BERT, "r1", "forbidden", 403),
        (control_request.reject, BERT, "r1", "forbidden", 403),
        (control_request.withdraw, ANNA, "r1", "forbidden", 403),
        (control_request.withdraw, BERT, "r2", "request-unknown", 404),
    ],
)
def test_only_holder_and_requester_answer(
    answer: Callable[..., Lease], caller: Identity, request_id: str, *, code: str, status: int
) -> None:
    with pytest.raises(Problem) as problem:
        answer(request_control(HELD), caller, request=request_id, now_ms=START)
    assert (problem.value.code, problem.value.status) == (code, status)


@pytest.mark.parametrize("answer", [control_request.accept, control_request.reject])
def test_an_expired_request_is_closed(answer: Callable[..., Lease]) -> None:
    with pytest.raises(Problem) as problem:
        answer(request_control(HELD), ANNA, request="r1", now_ms=START + 10_000)
    assert (problem.value.code, problem.value.status) == ("control-request-closed", 409)
    assert problem.value.extras == {"outcome": "expired"}


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
            control_request.reject(request_control(HELD), ANNA, request="r1", now_ms=START),
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
    requested = request_control(HELD)
    late = START + 60_000
    taken = lease.acquire(requested, CLEO, lease_ms=1_000, now_ms=late)
    assert facts_of(requested, taken, late) == [Fact.REQUEST_EXPIRED, Fact.EXPIRED, Fact.TAKEN]
    request_expired, lease_expired, _ = lease_changes(requested, taken, by="cleo", now_ms=late)
    assert (request_expired.at_ms, lease_expired.at_ms) == (START + 10_000, START + 60_000)
    assert list(timed_out(requested, late)) == [request_expired, lease_expired], "the timer creates the same event"
    assert list(timed_out(taken, late)) == []
    second = request_control(requested, CLEO, now_ms=START + 10_000, request="r2")
    assert facts_of(requested, second, START + 10_000) == [Fact.REQUEST_EXPIRED, Fact.REQUESTED]


def test_an_event_names_the_former_holder() -> None:
    over = lease.acquire(HELD, BERT, lease_ms=1_000, now_ms=START, over="needed")
    (event,) = lease_changes(HELD, over, by="bert", now_ms=START)
    assert event.data == {"epoch": 2, "holder": "bert", "from": "anna", "reason": "needed"}
    assert event.event("arm") | {"data": {}} == {
        "id": "control-taken-over-2",
        "device": "arm",
        "at_ms": START,
        "kind": "control-taken-over",
        "severity": "warning",
        "message": "bert took control from anna: needed",
        "data": {},
    }
    ended = control_ended(HELD, Lease(epoch=2), why="moved", now_ms=START)
    assert (ended.fact, ended.data) == (Fact.ENDED, {"epoch": 2, "holder": "anna", "reason": "moved", "ended_epoch": 1})


Step = tuple[str, Identity, int]
STEPS = ("take", "over", "renew", "release", "reset", "request", "accept", "reject", "withdraw")


def act(step: str, current: Lease | None, caller: Identity, *, now_ms: int, request_id: str) -> Lease:
    request = current.request.id if current is not None and current.request is not None else "none"
    epoch = current.epoch if current is not None else 1
    match step:
        case "take" | "over":
            over = "why" if step == "over" else ""
            after = lease.acquire(current, caller, lease_ms=20_000, now_ms=now_ms, pairing="p", over=over)
        case "renew":
            after = lease.renew(current, caller, epoch=epoch, lease_ms=20_000, now_ms=now_ms)
        case "release":
            after = lease.release(lease.require_held(current, caller, epoch=epoch, now_ms=now_ms), now_ms=now_ms)
        case "reset":
            after = lease.invalidate(current, pairing="p", now_ms=now_ms)
        case "request":
            after = request_control(current, caller, now_ms=now_ms, request=request_id)
        case "accept":
            after = control_request.accept(current, caller, request=request, now_ms=now_ms)
        case "reject":
            after = control_request.reject(current, caller, request=request, now_ms=now_ms)
        case _:
            after = control_request.withdraw(current, caller, request=request, now_ms=now_ms)
    return after


@given(
    st.lists(
        st.tuples(st.sampled_from(STEPS), st.sampled_from((ANNA, BERT, CLEO)), st.integers(0, 15_000)), max_size=30
    )
)
def test_requests_have_one_outcome_and_control_passes_only_by_consent(steps: list[Step]) -> None:
    current: Lease | None = None
    now_ms, number = START, 0
    events: list[ControlEvent] = []
    ends: dict[str, str] = {}
    for step, caller, later_ms in steps:
        now_ms += later_ms
        number += 1
        before = current
        try:
            current = act(step, before, caller, now_ms=now_ms, request_id=f"r{number}")
        except Problem:
            continue
        if current is not before:
            events += lease_changes(before, current, by=caller.name, now_ms=now_ms)
        _check_step(before, current, step, caller, now_ms)
        if current.request is not None and (end := current.request.current_outcome(current, now_ms)) != "open":
            assert ends.setdefault(current.request.id, end) == end, "the outcome is final"
    ids = [event.id for event in events]
    assert len(ids) == len(set(ids)), "an event was created twice"
    assert not [each for each in events if each.fact is Fact.HANDED_OVER and ends[each.data["request"]] != "accepted"]


def _check_step(before: Lease | None, after: Lease, step: str, caller: Identity, now_ms: int) -> None:
    if before is None:
        return
    assert after.epoch - before.epoch in {0, 1}
    transferred = (
        before.is_live(now_ms) and after.account and (after.account, after.session) != (before.account, before.session)
    )
    if transferred:
        assert after.epoch == before.epoch + 1, "a new holder has a new epoch"
        assert step == "over" or (step == "accept" and before.held_by(caller)), (
            "only the holder or an owner transfers control"
        )
    if step in {"request", "reject", "withdraw"}:
        assert replace(after, request=None) == replace(before, request=None)
