"""Leases have one holder, an expiry time and an epoch that only increases (see also test_control_request)."""

from dataclasses import replace

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.control import lease as rules
from function_app.domain.control.lease import Lease
from function_app.domain.identity.accounts import Identity

ANNA, ANNA_ELSEWHERE, BERT = Identity("a", "anna", "s1"), Identity("a", "anna", "s2"), Identity("b", "bert", "s3")
START = 1_000_000


def acquire(lease: Lease | None, caller: Identity, now_ms: int = START) -> Lease:
    return rules.acquire(lease, caller, lease_ms=1_000, now_ms=now_ms)


def test_a_lease_expires_and_each_acquisition_has_the_next_epoch() -> None:
    lease = acquire(None, ANNA)
    assert (lease.epoch, lease.holder, lease.expires_ms) == (1, "anna", START + 1_000)
    assert (lease.is_live(START + 999), lease.is_live(START + 1_000)) == (True, False)
    again = acquire(lease, ANNA, START + 10)
    assert (again.epoch, again.expires_ms) == (2, START + 1_010)
    free = rules.release(again, now_ms=START)
    assert not free.is_live(START)
    assert not any(free.held_by(caller) for caller in (ANNA, ANNA_ELSEWHERE, BERT))
    assert acquire(free, BERT).epoch == 3


@pytest.mark.parametrize("caller", [ANNA_ELSEWHERE, BERT])
def test_a_live_lease_is_exclusive_and_the_error_names_the_holder(caller: Identity) -> None:
    lease = acquire(None, ANNA)
    with pytest.raises(Problem) as caught:
        acquire(lease, caller, START + 999)
    assert (caught.value.code, caught.value.status) == ("lease-held", 409)
    assert caught.value.extras == {"holder": "anna", "expires_at": "1970-01-01T00:16:41.000Z", "mine": False}
    assert acquire(lease, caller, START + 1_000).epoch == 2


def test_renewing_keeps_the_epoch_and_extends_the_lease() -> None:
    renewed = rules.renew(replace(acquire(None, ANNA), action="x"), ANNA, epoch=1, lease_ms=5_000, now_ms=START + 900)
    assert (renewed.epoch, renewed.expires_ms, renewed.lease_ms) == (1, START + 5_900, 5_000)
    assert not renewed.action, "an explicitly held lease does not end with an action"


@pytest.mark.parametrize(
    ("caller", "epoch", "now_ms"),
    [(ANNA, 2, START), (ANNA, 0, START), (ANNA_ELSEWHERE, 1, START), (BERT, 1, START), (ANNA, 1, START + 1_000)],
)
def test_only_the_current_holder_renews_the_current_epoch(caller: Identity, epoch: int, now_ms: int) -> None:
    with pytest.raises(Problem) as caught:
        rules.renew(acquire(None, ANNA), caller, epoch=epoch, lease_ms=1_000, now_ms=now_ms)
    assert (caught.value.code, caught.value.extras) == ("lease-lost", {"epoch": epoch, "current_epoch": 1})
    with pytest.raises(Problem, match=f"epoch {epoch}"):
        rules.require_held(None, caller, epoch=epoch, now_ms=now_ms)
