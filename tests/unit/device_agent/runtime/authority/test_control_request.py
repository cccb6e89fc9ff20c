"""Pending control requests."""

import pytest

from device_agent.protocol import RequestControl
from device_agent.runtime.authority.control_request import PendingControlRequest
from device_agent.runtime.authority.lease_gate import Lease
from tests.harness.agent.controller_fixture import refuses

LEASE = Lease("ann", 5, 1_000.0)
ASKED = RequestControl(request="r1", requester="bob", answer_within_ms=30_000)


def asked(handover: PendingControlRequest, lease: Lease | None = LEASE, now_s: float = 100.0) -> str | None:
    found = handover.current(lease, now_s)
    return None if found is None else found.id


def test_a_request_expires() -> None:
    handover = PendingControlRequest()
    assert asked(handover) is None
    handover.open(ASKED, epoch=5, lease=LEASE, now_s=100.0)
    shown = handover.current(LEASE, 129.9)
    assert shown is not None
    assert (shown.requester, shown.epoch, shown.expires_s) == ("bob", 5, 130.0)
    assert asked(handover, now_s=130.0) is None
    assert asked(handover, now_s=100.0) is None, "what has lapsed stays so"


@pytest.mark.parametrize("lease", [None, Lease("ann", 6, 1_000.0)])
def test_a_request_ends_with_its_lease(lease: Lease | None) -> None:
    handover = PendingControlRequest()
    handover.open(ASKED, epoch=5, lease=LEASE, now_s=100.0)
    assert asked(handover, lease) is None
    assert asked(handover) is None


@pytest.mark.parametrize(("epoch", "lease"), [(4, LEASE), (6, LEASE), (5, None)])
def test_a_request_for_another_lease_is_rejected(epoch: int, lease: Lease | None) -> None:
    handover = PendingControlRequest()
    with refuses("no_lease"):
        handover.open(ASKED, epoch=epoch, lease=lease, now_s=100.0)
    assert asked(handover) is None


def test_a_withdrawal_may_precede_its_request_and_affects_no_other() -> None:
    handover = PendingControlRequest()
    handover.withdraw("r1")
    handover.open(ASKED, epoch=5, lease=LEASE, now_s=100.0)
    assert asked(handover) is None
    handover.open(
        RequestControl(request="r2", requester="cid", answer_within_ms=1_000), epoch=5, lease=LEASE, now_s=100.0
    )
    handover.withdraw("r1")
    assert asked(handover) == "r2"
    handover.withdraw("r2")
    assert asked(handover) is None
