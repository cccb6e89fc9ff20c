"""Converts leases and control requests to API responses."""

from function_app.domain.common.timestamps import rfc3339
from function_app.domain.control.lease import ControlRequest, Lease
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.control.schemas import ControlRequestOut, LeaseOut


def lease_out(lease: Lease | None, caller: Identity, now_ms: int) -> LeaseOut | None:
    """The response for an active lease with its open control request."""
    if lease is None:
        return None
    request = None if lease.request is None else control_request_out(lease.request, lease, caller, now_ms)
    return LeaseOut(
        holder=lease.holder,
        holder_account=lease.account,
        epoch=lease.epoch,
        expires_at=rfc3339(lease.expires_ms),
        mine=lease.held_by(caller),
        reason=lease.reason,
        request=request if request is not None and request.outcome == "open" else None,
    )


def control_request_out(request: ControlRequest, lease: Lease, caller: Identity, now_ms: int) -> ControlRequestOut:
    """The response for a control request, with its outcome at ``now_ms``."""
    return ControlRequestOut(
        id=request.id,
        requester=request.by,
        requester_account=request.account,
        epoch=request.epoch,
        mine=request.requested_by(caller),
        requested_at=rfc3339(request.requested_ms),
        expires_at=rfc3339(request.expires_ms),
        outcome=request.current_outcome(lease, now_ms),
    )
