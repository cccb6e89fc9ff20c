"""Lease rules: one holder, a time limit, an epoch that only rises."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.common.problems import Problem
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity

ANNA = Identity("a", "anna", "s1")
ANNA_ELSEWHERE = Identity("a", "anna", "s2")
BERT = Identity("b", "bert", "s3")
EVERYBODY = (ANNA, ANNA_ELSEWHERE, BERT)
START = 1_000_000


def take(lease: Lease | None, who: Identity, now_ms: int = START, lease_ms: int = 1_000) -> Lease:
    return rules.acquire(lease, who, lease_ms=lease_ms, now_ms=now_ms)


def test_the_first_lease_has_epoch_1_and_ends_on_time() -> None:
    lease = take(None, ANNA)
    assert (lease.epoch, lease.holder, lease.expires_ms) == (1, "anna", START + 1_000)
    assert lease.is_live(START + 999)
    assert not lease.is_live(START + 1_000)


def test_the_holder_who_takes_again_gets_the_next_epoch() -> None:
    again = take(take(None, ANNA), ANNA, START + 10)
    assert (again.epoch, again.expires_ms) == (2, START + 1_010)


@pytest.mark.parametrize("who", [ANNA_ELSEWHERE, BERT])
def test_nobody_else_takes_a_live_lease_and_is_told_whose_it_is(who: Identity) -> None:
    lease = take(None, ANNA)
    with pytest.raises(Problem) as caught:
        take(lease, who, START + 999)
    assert (caught.value.code, caught.value.status) == ("lease-held", 409)
    assert caught.value.extras == {"holder": "anna", "expires_at": "1970-01-01T00:16:41.000Z", "mine": False}
    assert take(lease, who, START + 1_000).epoch == 2


def test_renewing_keeps_the_epoch_and_moves_the_end() -> None:
    lease = replace(take(None, ANNA), action="x")
    renewed = rules.renew(lease, ANNA, epoch=1, lease_ms=5_000, now_ms=START + 900)
    assert (renewed.epoch, renewed.expires_ms, renewed.lease_ms) == (1, START + 5_900, 5_000)
    assert renewed.action == "", "what is held on purpose does not end with an action"


@pytest.mark.parametrize(
    ("who", "epoch", "now_ms"),
    [
        (ANNA, 2, START),
        (ANNA, 0, START),
        (ANNA_ELSEWHERE, 1, START),
        (BERT, 1, START),
        (ANNA, 1, START + 1_000),
    ],
)
def test_what_is_not_held_now_is_not_renewed(who: Identity, epoch: int, now_ms: int) -> None:
    lease = take(None, ANNA)
    with pytest.raises(Problem) as caught:
        rules.renew(lease, who, epoch=epoch, lease_ms=1_000, now_ms=now_ms)
    assert (caught.value.code, caught.value.extras) == ("lease-lost", {"epoch": epoch, "current_epoch": 1})


def test_a_lease_that_never_was_is_lost() -> None:
    with pytest.raises(Problem, match="epoch 3"):
        rules.require_held(None, ANNA, epoch=3, now_ms=START)


def test_a_released_lease_is_nobodys_and_keeps_its_epoch() -> None:
    free = rules.release(take(take(None, ANNA), ANNA), now_ms=START)
    assert not free.is_live(START)
    assert not any(free.held_by(who) for who in EVERYBODY)
    assert take(free, BERT).epoch == 3


Step = tuple[str, Identity, int]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["take", "renew", "release"]),
            st.sampled_from(EVERYBODY),
            st.integers(min_value=0, max_value=1_500),
        )
    )
)
def test_whatever_happens_epochs_rise_and_a_live_lease_stays_with_its_holder(steps: list[Step]) -> None:
    lease: Lease | None = None
    now_ms = START
    granted: set[int] = set()
    for what, who, later_ms in steps:
        now_ms += later_ms
        before = lease
        try:
            if what == "take":
                lease = take(lease, who, now_ms)
                assert lease.epoch not in granted
                granted.add(lease.epoch)
            elif lease is not None and what == "renew":
                lease = rules.renew(lease, who, epoch=lease.epoch, lease_ms=1_000, now_ms=now_ms)
            elif lease is not None:
                held = rules.require_held(lease, who, epoch=lease.epoch, now_ms=now_ms)
                lease = rules.release(held, now_ms=now_ms)
        except Problem:
            assert lease is before
        if before is not None and lease is not None:
            assert lease.epoch >= before.epoch
            if before.is_live(now_ms) and not before.held_by(who):
                assert lease == before
