"""Requests and responses of leases, control requests and MQTT credentials."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import Epoch, LeaseMs, Moment, Request, Response, WaitMs

WithinMs = Annotated[int, Meta(ge=1_000, le=120_000)]
Why = Annotated[str, Meta(max_length=200)]


class ControlRequestOut(Response, frozen=True, kw_only=True):
    """A request for control. ``mine``: from the caller's session. ``epoch``: epoch of the requested lease.

    ``ended``: the requested lease ended in another way.
    """

    id: str
    requester: str
    epoch: int
    mine: bool
    requested_at: Moment
    expires_at: Moment
    outcome: Literal["open", "accepted", "rejected", "withdrawn", "expired", "ended"]


class LeaseOut(Response, frozen=True, kw_only=True):
    """The lease of a device. ``reason``: why control was taken over. ``request``: the open control request."""

    holder: str
    epoch: int
    expires_at: Moment
    mine: bool
    reason: str
    request: ControlRequestOut | None


class LeaseRequest(Request, frozen=True, kw_only=True):
    """Without ``epoch``: take. With it: renew that epoch.

    ``take_over``: take control from its holder. Owners only; requires a ``reason``.
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
    """Time for the holder's response, and the requested duration of the lease [ms]."""

    within_ms: WithinMs = 30_000
    lease_ms: LeaseMs = 30_000
    wait_ms: WaitMs = 1_000


class ControlRequestCreated(Response, frozen=True, kw_only=True):
    """The caller's request. ``confirmed``: the device shows it to all viewers."""

    request: ControlRequestOut
    confirmed: bool


class AcceptControlRequest(Request, frozen=True, kw_only=True):
    """How long to wait for the device."""

    wait_ms: WaitMs = 1_000


class ControlRequestAccepted(Response, frozen=True, kw_only=True):
    """The request, and the new epoch of the requester. ``confirmed``: the device has acknowledged it."""

    request: ControlRequestOut
    epoch: int
    confirmed: bool


class ViewCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="view"):
    """To see every device and to stop those one may operate."""


class ControlCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="control"):
    """To send setpoints under a lease."""

    device: Id
    epoch: Epoch


class AgentCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="agent"):
    """To publish for an agent's own devices."""


MqttCredentialsRequest = ViewCredentialsRequest | ControlCredentialsRequest | AgentCredentialsRequest


class TcpAddress(Response, frozen=True, kw_only=True):
    """Address of the broker for MQTT. It requires agent certificates issued after ``certificate_after_ms``."""

    host: str
    port: int
    tls: bool
    certificate_after_ms: int | None = None


class MqttCredentialsOut(Response, frozen=True, kw_only=True):
    """Credentials, and the topics that they grant. For an agent also updates of the server's signing keys."""

    client_id: str
    username: str
    password: str
    expires_at: Moment
    lifetime_s: int
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    tcp: TcpAddress
    websocket_url: str
    server_time_ms: int
    key_statements: tuple[str, ...] = ()
    signing_key: str = ""
