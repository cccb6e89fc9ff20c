"""Lease rules: every field of the result, and the limits of time and epoch."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.common.timestamps import CLOCK_SKEW_MS
from function_app.domain.control import lease as rules
from function_app.domain.control.control_request import request_control
from function_app.domain.control.lease import MAX_EPOCH_JUMP, RESTORE_JUMP, Lease
from function_app.domain.identity.accounts import Identity

ANNA, BERT = Identity("a", "anna", "s1"), Identity("b", "bert", "s2")
SECOND_SESSION = replace(ANNA, session="s3")
NOW = 1_000_000
HELD = Lease(epoch=7, account="a", session="s1", holder="anna", expires_ms=NOW + 60_000, lease_ms=60_000, pairing="p")
REQUESTED = request_control(HELD, BERT, request="r", within_ms=10_000, lease_ms=20_000, now_ms=NOW)


def closed(outcome: str) -> rules.ControlRequest:
    assert REQUESTED.request is not None
    return replace(REQUESTED.request, outcome=outcome)  # type: ignore[arg-type]


def test_a_grant_has_the_next_epoch_and_every_field_of_the_caller() -> None:
    granted = rules.acquire(None, ANNA, lease_ms=60_000, now_ms=NOW, pairing="p", action="x")
    assert granted == replace(HELD, epoch=1, action="x")
    again = rules.acquire(REQUESTED, ANNA, lease_ms=9_000, now_ms=NOW + 1, pairing="p", over="no reason needed")
    assert again == replace(HELD, epoch=8, expires_ms=NOW + 9_001, lease_ms=9_000, request=closed("ended"))
    taken = rules.acquire(HELD, BERT, lease_ms=60_000, now_ms=NOW, pairing="p", over="fire")
    assert taken == replace(HELD, epoch=8, account="b", session="s2", holder="bert", reason="fire")


@pytest.mark.parametrize("caller", [BERT, SECOND_SESSION])
def test_only_an_expired_lease_is_granted_to_another_session(caller: Identity) -> None:
    with pytest.raises(Problem) as problem:
        rules.acquire(HELD, caller, lease_ms=1_000, now_ms=NOW + 59_999)
    assert (problem.value.code, problem.value.status) == ("lease-held", 409)
    assert problem.value.extras == {"holder": "anna", "expires_at": "1970-01-01T00:17:40.000Z", "mine": False}
    assert rules.acquire(HELD, caller, lease_ms=1_000, now_ms=NOW + 60_000).epoch == 8


@pytest.mark.parametrize(
    ("now_ms", "live"),
    [(NOW - CLOCK_SKEW_MS - 1, False), (NOW - CLOCK_SKEW_MS, True), (NOW + 59_999, True), (NOW + 60_000, False)],
)
def test_a_lease_is_live_until_its_end_unless_the_clock_was_set_back(now_ms: int, live: bool) -> None:
    assert HELD.is_live(now_ms) is live
    assert not replace(HELD, account="").is_live(now_ms)


def test_a_renewal_changes_only_the_time_and_is_no_longer_for_one_action() -> None:
    held = replace(HELD, action="x", reason="fire")
    renewed = rules.renew(held, ANNA, epoch=7, lease_ms=5_000, now_ms=NOW + 1)
    assert renewed == replace(held, action="", expires_ms=NOW + 5_001, lease_ms=5_000)


@pytest.mark.parametrize(
    ("lease", "caller", "epoch", "now_ms", "current"),
    [
        (None, ANNA, 7, NOW, 0),
        (HELD, ANNA, 6, NOW, 7),
        (HELD, BERT, 7, NOW, 7),
        (HELD, SECOND_SESSION, 7, NOW, 7),
        (HELD, replace(BERT, session="s1"), 7, NOW, 7),
        (HELD, ANNA, 7, NOW + 60_000, 7),
        (Lease(epoch=7, expires_ms=NOW + 1), Identity("", "", ""), 7, NOW, 7),
    ],
)
def test_a_lost_lease_is_not_renewed(
    lease: Lease | None, caller: Identity, epoch: int, now_ms: int, current: int
) -> None:
    with pytest.raises(Problem) as problem:
        rules.renew(lease, caller, epoch=epoch, lease_ms=1_000, now_ms=now_ms)
    assert (problem.value.code, problem.value.status) == ("lease-lost", 409)
    assert problem.value.extras == {"epoch": epoch, "current_epoch": current}


@pytest.mark.parametrize(
    ("end", "epoch"),
    [
        (lambda lease: rules.release(lease, now_ms=NOW), 7),
        (lambda lease: rules.invalidate(lease, pairing="p", now_ms=NOW), 8),
        (lambda lease: rules.after_restore(lease, pairing="p", now_ms=NOW), 8 + RESTORE_JUMP),
        (lambda lease: rules.catch_up(lease, 9, now_ms=NOW), 9),
        (lambda lease: rules.catch_up(lease, 8 + MAX_EPOCH_JUMP, now_ms=NOW), 7 + MAX_EPOCH_JUMP),
    ],
)
def test_a_freed_lease_keeps_only_epoch_pairing_and_the_closed_request(
    end: Callable[[Lease], Lease], epoch: int
) -> None:
    assert end(REQUESTED) == Lease(epoch=epoch, pairing="p", request=closed("ended"))
    assert end(HELD) == Lease(epoch=epoch, pairing="p")


def test_a_device_without_a_lease_starts_with_the_first_epoch() -> None:
    assert rules.invalidate(None, pairing="p", now_ms=NOW) == Lease(epoch=1, pairing="p")
    assert rules.after_restore(None, pairing="p", now_ms=NOW) == Lease(epoch=1 + RESTORE_JUMP, pairing="p")
    assert rules.catch_up(None, 0, now_ms=NOW) is None
    assert rules.catch_up(None, 1, now_ms=NOW) == Lease(epoch=1)
    assert rules.catch_up(None, MAX_EPOCH_JUMP + 1, now_ms=NOW) == Lease(epoch=MAX_EPOCH_JUMP)


@pytest.mark.parametrize("device_epoch", [6, 7])
def test_a_device_that_is_not_ahead_changes_nothing(device_epoch: int) -> None:
    assert rules.catch_up(HELD, device_epoch, now_ms=NOW) is HELD


def test_a_closed_request_keeps_its_outcome() -> None:
    for outcome in ("accepted", "rejected", "withdrawn"):
        assert replace(HELD, request=closed(outcome)).closed_request(NOW) == closed(outcome)
    assert REQUESTED.closed_request(NOW + 10_000) == closed("expired")


@pytest.mark.parametrize(
    ("lease_ms", "left_ms", "granted"), [(60_000, 5_000, 5_000), (2_000, 5_000, 2_000), (9, 1, 1_000)]
)
def test_a_lease_is_not_longer_than_the_permission(lease_ms: int, left_ms: int, granted: int) -> None:
    assert rules.granted_ms(lease_ms, left_ms) == granted
