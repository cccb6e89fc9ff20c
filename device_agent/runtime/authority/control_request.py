"""Who asks the holder for control. Shown to everybody in ``state``; nothing about motion depends on it."""

from dataclasses import dataclass

from device_agent.protocol import RequestControl
from device_agent.runtime.authority.lease_gate import Lease
from device_agent.runtime.errors import Refused


@dataclass(frozen=True, slots=True)
class Asked:
    """A request that waits for its answer until ``expires_s`` on the agent's monotonic clock [s]."""

    id: str
    by: str
    epoch: int
    expires_s: float


class PendingControlRequest:
    """The one open request of one device. Not thread-safe: the office alone uses it."""

    def __init__(self) -> None:
        self._asked: Asked | None = None
        self._dropped = ""

    def ask(self, order: RequestControl, *, epoch: int, lease: Lease | None, now_s: float) -> None:
        """Show a request until it is dropped, its time is over, or the lease that it asks for has ended.

        Raises:
            Refused: The lease that it asks for is not the one in force.
        """
        if lease is None or lease.epoch != epoch:
            raise Refused("no_lease", f"lease {epoch} is not in force here; there is nothing to ask for")
        # Two of the cloud's processes may have sent the end of it and the request itself in the other order.
        if order.request != self._dropped:
            self._asked = Asked(order.request, order.requester, epoch, now_s + order.answer_within_ms / 1000)

    def drop(self, request: str) -> None:
        """Show it no longer; the end of an earlier request does not end a later one."""
        self._dropped = request
        if self._asked is not None and self._asked.id == request:
            self._asked = None

    def current(self, lease: Lease | None, now_s: float) -> Asked | None:
        """The open request to the holder of ``lease``, the one in force."""
        asked = self._asked
        if asked is not None and (lease is None or lease.epoch != asked.epoch or now_s >= asked.expires_s):
            asked = self._asked = None
        return asked
