"""Pending control requests."""

import msgspec
import pytest

from device_agent.protocol import RequestControl
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.lease_gate import Lease
from tests.harness.agent.controller_fixture import refuses

LEASE = Lease("ann", 5, 1_000.0)
REQUEST = RequestControl(request="r1", requester="bob", answer_within_ms=30_000)


@pytest.fixture
def pending() -> PendingControlRequest:
    """One request for the lease."""
    pending = PendingControlRequest()
    assert current(pending) is None
    pending.open(REQUEST, epoch=5, lease=LEASE, now_s=100.0)
    return pending


def current(pending: PendingControlRequest, lease: Lease | None = LEASE, now_s: float = 100.0) -> str | None:
    request = pending.current(lease, now_s)
    return None if request is None else request.id


def test_a_request_expires(pending: PendingControlRequest) -> None:
    request = pending.current(LEASE, 129.9)
    assert request is not None
    assert (request.requester, request.epoch, request.expires_s) == ("bob", 5, 130.0)
    assert current(pending, now_s=130.0) is None
    assert current(pending, now_s=100.0) is None, "an expired request stays expired"


@pytest.mark.parametrize("lease", [None, Lease("ann", 6, 1_000.0)])
def test_a_request_ends_with_its_lease(pending: PendingControlRequest, lease: Lease | None) -> None:
    assert current(pending, lease) is None
    assert current(pending) is None


@pytest.mark.parametrize(("epoch", "lease"), [(4, LEASE), (6, LEASE), (5, None)])
def test_a_request_for_another_lease_is_rejected(epoch: int, lease: Lease | None) -> None:
    pending = PendingControlRequest()
    with refuses("no_lease"):
        pending.open(REQUEST, epoch=epoch, lease=lease, now_s=100.0)
    assert current(pending) is None


def test_a_withdrawal_may_precede_its_request_and_affects_no_other() -> None:
    pending = PendingControlRequest()
    pending.withdraw("r1")
    pending.open(REQUEST, epoch=5, lease=LEASE, now_s=100.0)
    assert current(pending) is None
    pending.open(msgspec.structs.replace(REQUEST, request="r2"), epoch=5, lease=LEASE, now_s=100.0)
    pending.withdraw("r1")
    assert current(pending) == "r2"
    pending.withdraw("r2")
    assert current(pending) is None
