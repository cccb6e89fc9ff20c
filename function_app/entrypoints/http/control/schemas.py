"""``devices/{id}/lease``: who controls it, and who asks for that."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.framework.schemas import Epoch, LeaseMs, Moment, Request, Response, WaitMs

WithinMs = Annotated[int, Meta(ge=1_000, le=120_000)]
Why = Annotated[str, Meta(max_length=200)]


class ControlRequestOut(Response, frozen=True, kw_only=True):
    """Somebody asks for control. ``mine``: you ask; ``epoch``: of the lease that is asked for.

    ``ended``: the lease that it asked for has ended otherwise; look who has control now.
    """

    id: str
    requester: str
    epoch: int
    mine: bool
    requested_at: Moment
    expires_at: Moment
    outcome: Literal["open", "accepted", "rejected", "withdrawn", "expired", "ended"]


class LeaseOut(Response, frozen=True, kw_only=True):
    """Who controls a device. ``reason``: why it was taken from somebody else; ``request``: the open one, if any."""

    holder: str
    epoch: int
    expires_at: Moment
    mine: bool
    reason: str
    request: ControlRequestOut | None


class LeaseRequest(Request, frozen=True, kw_only=True):
    """Without ``epoch``: take. With it: renew that epoch.

    ``take_over``: take it even from somebody who holds it; only owners may, and say why in ``reason``.
    """

    lease_ms: LeaseMs = 30_000
    epoch: Epoch | None = None
    wait_ms: WaitMs = 1_000
    take_over: bool = False
    reason: Why = ""


class LeaseGranted(Response, frozen=True, kw_only=True):
    """The caller's lease. ``confirmed``: the device has acknowledged it."""

    epoch: int
    holder: str
    expires_at: Moment
    lease_ms: int
    confirmed: bool


class LeaseStatus(Response, frozen=True, kw_only=True):
    """The live lease of a device, if any."""

    lease: LeaseOut | None


class NewControlRequest(Request, frozen=True, kw_only=True):
    """How long the holder has for an answer, and for how long control is wanted."""

    within_ms: WithinMs = 30_000
    lease_ms: LeaseMs = 30_000
    wait_ms: WaitMs = 1_000


class ControlRequestCreated(Response, frozen=True, kw_only=True):
    """The caller's request. ``confirmed``: the device shows it to everybody who watches."""

    request: ControlRequestOut
    confirmed: bool


class AcceptControlRequest(Request, frozen=True, kw_only=True):
    """How long to wait for the device."""

    wait_ms: WaitMs = 1_000


class ControlRequestAccepted(Response, frozen=True, kw_only=True):
    """The request, and the epoch that who asked has now. ``confirmed``: the device obeys it already."""

    request: ControlRequestOut
    epoch: int
    confirmed: bool
