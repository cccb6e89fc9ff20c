"""Requests and responses of leases, control requests and MQTT credentials."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import (
    AgentRequest,
    Epoch,
    LabelledRequest,
    LeaseMs,
    Moment,
    Request,
    Response,
    WaitMs,
)

WithinMs = Annotated[int, Meta(ge=1_000, le=120_000)]
TakeoverReason = Annotated[str, Meta(max_length=200)]


class ControlRequestOut(Response, frozen=True, kw_only=True):
    """A control request. ``mine``: it is from the caller's session. ``epoch``: epoch of the requested lease.

    ``ended``: the requested lease ended in another way.
    """

    id: str
    requester: str
    requester_account: str
    epoch: int
    mine: bool
    requested_at: Moment
    expires_at: Moment
    outcome: Literal["open", "accepted", "rejected", "withdrawn", "expired", "ended"]


class LeaseOut(Response, frozen=True, kw_only=True):
    """The lease of a device. ``reason``: why control was taken over. ``request``: the open control request.

    ``holder_account``: id of the account. Names can resemble each other; ids cannot.
    """

    holder: str
    holder_account: str
    epoch: int
    expires_at: Moment
    mine: bool
    reason: str
    request: ControlRequestOut | None


class LeaseRequest(LabelledRequest, frozen=True, kw_only=True):
    """Without ``epoch``: acquire a new lease. With ``epoch``: renew that lease.

    ``take_over``: take control from the current holder. Owners only; requires a ``reason``.
    """

    labels: ClassVar = ("reason",)
    lease_ms: LeaseMs = 30_000
    epoch: Epoch | None = None
    wait_ms: WaitMs = 1_000
    take_over: bool = False
    reason: TakeoverReason = ""


class LeaseGranted(Response, frozen=True, kw_only=True):
    """The caller's lease. ``confirmed``: the device has acknowledged it.

    ``setpoint_key``: secret key in hexadecimal that authenticates the setpoints of this lease.
    ``streaming``: setpoints reach the device; otherwise only actions move it.
    """

    epoch: int
    holder: str
    expires_at: Moment
    lease_ms: int
    confirmed: bool
    setpoint_key: str
    streaming: bool


class LeaseStatus(Response, frozen=True, kw_only=True):
    """The active lease of a device; null if it is free."""

    lease: LeaseOut | None


class NewControlRequest(Request, frozen=True, kw_only=True):
    """A control request. ``within_ms``: time for the response. ``lease_ms``: duration of the requested lease."""

    within_ms: WithinMs = 30_000
    lease_ms: LeaseMs = 30_000
    wait_ms: WaitMs = 1_000


class ControlRequestCreated(Response, frozen=True, kw_only=True):
    """The caller's request. ``confirmed``: the device has published it in its ``state``."""

    request: ControlRequestOut
    confirmed: bool


class AcceptControlRequest(Request, frozen=True, kw_only=True):
    """``wait_ms``: maximum time to wait for the device's acknowledgement."""

    wait_ms: WaitMs = 1_000


class ControlRequestAccepted(Response, frozen=True, kw_only=True):
    """The request, and the new epoch of the requester. ``confirmed``: the device has acknowledged it."""

    request: ControlRequestOut
    epoch: int
    confirmed: bool


class ViewCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="view"):
    """Credentials to receive data of all devices of the account, and to stop those that it may operate."""


class ControlCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="control"):
    """Credentials to send setpoints under a lease."""

    device: Id
    epoch: Epoch


class AgentCredentialsRequest(AgentRequest, frozen=True, kw_only=True, tag_field="purpose", tag="agent"):
    """Credentials of an agent for its own devices."""


MqttCredentialsRequest = ViewCredentialsRequest | ControlCredentialsRequest | AgentCredentialsRequest


class TcpAddress(Response, frozen=True, kw_only=True):
    """Address of the broker for MQTT over TCP.

    ``certificate_after_ms``: the broker requires agent certificates issued after this time [ms since 1970]; null: none.
    """

    host: str
    port: int
    tls: bool
    certificate_after_ms: int | None = None


class MqttCredentialsOut(Response, frozen=True, kw_only=True):
    """Credentials and their topics.

    For an agent also the statements that rotate the server's signing keys, and ``confirmations``: the topics on which
    the server confirms acks, events and late measurements after storage. An agent that subscribes to them repeats these
    messages until confirmation.
    """

    client_id: str
    username: str
    password: str
    expires_at: Moment
    lifetime_s: int
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    confirmations: str | None = None
    tcp: TcpAddress
    websocket_url: str
    server_time_ms: int
    key_statements: tuple[str, ...] = ()
    signing_key: str = ""
