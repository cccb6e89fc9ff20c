"""Pending request for control, as ``state`` shows it. It has no effect on motion."""

from dataclasses import dataclass

from device_agent.protocol import RequestControl
from device_agent.runtime.authority.lease_gate import Lease
from device_agent.runtime.errors import Refused


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """Request that the holder can answer until ``expires_s`` on the agent's monotonic clock [s]."""

    id: str
    requester: str
    epoch: int
    expires_s: float


class PendingControlRequest:
    """The one open request of a device. Not thread-safe: only the command processor uses it."""

    def __init__(self) -> None:
        self._request: ControlRequest | None = None
        self._withdrawn = ""

    def open(self, request: RequestControl, *, epoch: int, lease: Lease | None, now_s: float) -> None:
        """Show a request until it is withdrawn, it expires, or the requested lease ends.

        Raises:
            Refused: The requested lease is not in force.
        """
        if lease is None or lease.epoch != epoch:
            raise Refused("no_lease", f"lease {epoch} is not in force, so control cannot be requested")
        # Two cloud processes may have sent the request and its withdrawal in the opposite order.
        if request.request != self._withdrawn:
            self._request = ControlRequest(
                request.request, request.requester, epoch, now_s + request.answer_within_ms / 1000
            )

    def withdraw(self, request: str) -> None:
        """Remove a request. Withdrawing an earlier request does not remove a later one."""
        self._withdrawn = request
        if self._request is not None and self._request.id == request:
            self._request = None

    def current(self, lease: Lease | None, now_s: float) -> ControlRequest | None:
        """The open request to the holder of ``lease``, the lease in force."""
        request = self._request
        if request is not None and (lease is None or lease.epoch != request.epoch or now_s >= request.expires_s):
            request = self._request = None
        return request
