"""Asking for control: of all that may become of a request exactly one thing does, and all of it is told."""

from dataclasses import replace
from typing import Any

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


def ask(known: Lease | None, who: Identity = BERT, *, now_ms: int = START, request: str = "r1") -> Lease:
    return control_request.request_control(
        known, who, request=request, within_ms=10_000, lease_ms=20_000, now_ms=now_ms
    )


def kinds(before: Lease | None, after: Lease, now_ms: int = START) -> list[Fact]:
    return [happened.fact for happened in lease_changes(before, after, by="somebody", now_ms=now_ms)]


def how(known: Lease, now_ms: int) -> str:
    assert known.request is not None
    return known.request.current_outcome(known, now_ms)


def test_to_ask_changes_nothing_about_the_lease() -> None:
    asked = ask(HELD)
    assert replace(asked, request=None) == HELD
    assert how(asked, START + 9_999) == "open"
    assert how(asked, START + 10_000) == "expired"
    assert ask(asked) is asked
    short = lease.renew(HELD, ANNA, epoch=1, lease_ms=5_000, now_ms=START)
    assert how(ask(short), START + 5_000) == "ended", "with the lease that it asks for"
    assert kinds(HELD, asked) == [Fact.REQUESTED]


def test_an_accepted_request_is_a_new_lease() -> None:
    given_ = control_request.accept(ask(HELD), ANNA, request="r1", now_ms=START + 5)
    assert (given_.epoch, given_.holder, given_.expires_ms, given_.pairing) == (2, "bert", START + 20_005, "p")
    assert given_.held_by(BERT)
    assert kinds(ask(HELD), given_) == [Fact.HANDED_OVER]
    assert control_request.accept(given_, ANNA, request="r1", now_ms=START + 6) is given_


@pytest.mark.parametrize(
    ("what", "code"),
    [
        (lambda: ask(None), "lease-free"),
        (lambda: ask(HELD, now_ms=START + 60_000), "lease-free"),
        (lambda: ask(HELD, ANNA), "lease-already-held"),
        (lambda: ask(ask(HELD), CLEO, request="r2"), "lease-requested"),
        (lambda: act("accept", None, ANNA, now_ms=START, fresh=""), "request-unknown"),
        (lambda: act("accept", ask(HELD), CLEO, now_ms=START, fresh=""), "forbidden"),
        (lambda: act("withdraw", ask(HELD), ANNA, now_ms=START, fresh=""), "forbidden"),
        (lambda: act("accept", ask(HELD), ANNA, now_ms=START + 10_000, fresh=""), "control-request-closed"),
    ],
)
def test_what_cannot_be_is_refused(what: Any, code: str) -> None:
    with pytest.raises(Problem) as refused:
        what()
    assert refused.value.code == code


def test_who_has_been_given_control_gives_it_back_instead_of_withdrawing() -> None:
    given_ = control_request.accept(ask(HELD), ANNA, request="r1", now_ms=START)
    with pytest.raises(Problem, match="requester has control"):
        control_request.withdraw(given_, BERT, request="r1", now_ms=START)
    kept = control_request.refuse(ask(HELD), ANNA, request="r1", now_ms=START)
    assert control_request.refuse(kept, ANNA, request="r1", now_ms=START) is kept
    lapsed = ask(HELD)
    assert control_request.withdraw(lapsed, BERT, request="r1", now_ms=START + 10_000) is lapsed


def test_only_the_lease_that_was_in_force_when_it_was_asked_is_handed_over() -> None:
    again = lease.acquire(ask(HELD), ANNA, lease_ms=60_000, now_ms=START + 1)
    assert how(again, START + 1) == "ended"
    with pytest.raises(Problem) as refused:
        control_request.accept(again, ANNA, request="r1", now_ms=START + 1)
    assert (refused.value.code, refused.value.extras) == ("control-request-closed", {"outcome": "ended"})


@pytest.mark.parametrize(
    ("before", "after", "facts"),
    [
        (None, HELD, [Fact.TAKEN]),
        (HELD, lease.renew(HELD, ANNA, epoch=1, lease_ms=9_000, now_ms=START), []),
        (HELD, lease.release(HELD, now_ms=START), [Fact.RELEASED]),
        (HELD, lease.acquire(HELD, ANNA, lease_ms=1_000, now_ms=START), [Fact.TAKEN]),
        (HELD, lease.acquire(HELD, BERT, lease_ms=1_000, now_ms=START, over="now"), [Fact.TAKEN_OVER]),
        (HELD, lease.invalidate(HELD, pairing="p", now_ms=START), [Fact.RESET_ORDERED]),
        (None, lease.invalidate(None, pairing="p", now_ms=START), [Fact.RESET_ORDERED]),
        (ask(HELD), control_request.refuse(ask(HELD), ANNA, request="r1", now_ms=START), [Fact.REQUEST_REFUSED]),
        (ask(HELD), control_request.withdraw(ask(HELD), BERT, request="r1", now_ms=START), [Fact.REQUEST_WITHDRAWN]),
        (replace(HELD, action="x"), lease.release(replace(HELD, action="x"), now_ms=START), []),
    ],
)
def test_each_change_is_told_as_what_it_is(before: Lease | None, after: Lease, facts: list[Fact]) -> None:
    assert kinds(before, after) == facts


def test_what_time_has_brought_is_told_with_the_next_change_and_at_its_own_time() -> None:
    asked = ask(HELD)
    late = START + 60_000
    taken = lease.acquire(asked, CLEO, lease_ms=1_000, now_ms=late)
    assert kinds(asked, taken, late) == [Fact.REQUEST_LAPSED, Fact.EXPIRED, Fact.TAKEN]
    lapsed, expired, _ = lease_changes(asked, taken, by="cleo", now_ms=late)
    assert (lapsed.at_ms, expired.at_ms) == (START + 10_000, START + 60_000)
    assert list(timed_out(asked, late)) == [lapsed, expired], "told by the timer it is the same event"
    assert list(timed_out(None, late)) == list(timed_out(taken, late)) == []
    second = ask(asked, CLEO, now_ms=START + 10_000, request="r2")
    assert kinds(asked, second, START + 10_000) == [Fact.REQUEST_LAPSED, Fact.REQUESTED]


def test_an_event_names_who_had_control() -> None:
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


def act(what: str, known: Lease | None, who: Identity, *, now_ms: int, fresh: str) -> Lease:
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
            after = ask(known, who, now_ms=now_ms, request=fresh)
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
def test_whatever_is_done_at_once_each_request_has_one_end_and_control_passes_only_by_consent(
    steps: list[Step],
) -> None:
    known: Lease | None = None
    now_ms, number = START, 0
    told: list[ControlEvent] = []
    ends: dict[str, str] = {}
    for what, who, later_ms in steps:
        now_ms += later_ms
        number += 1
        before = known
        try:
            known = act(what, before, who, now_ms=now_ms, fresh=f"r{number}")
        except Problem:
            continue
        if known is not before:
            told += lease_changes(before, known, by=who.name, now_ms=now_ms)
        _see(before, known, what, who, now_ms)
        if known.request is not None and (end := known.request.current_outcome(known, now_ms)) != "open":
            assert ends.setdefault(known.request.id, end) == end, "it had another end before"
    ids = [happened.id for happened in told]
    assert len(ids) == len(set(ids)), "told twice in two batches"
    assert not [each for each in told if each.fact is Fact.HANDED_OVER and ends[each.data["request"]] != "accepted"]


def _see(before: Lease | None, after: Lease, what: str, who: Identity, now_ms: int) -> None:
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
