"""Requests and responses of leases, control requests and MQTT credentials."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id
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


class ViewCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="view"):
    """To see every device and to stop those one may operate."""


class ControlCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="control"):
    """To send setpoints under a lease."""

    device: Id
    epoch: Epoch


class AgentCredentialsRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="agent"):
    """To speak for an agent's own devices."""


MqttCredentialsRequest = ViewCredentialsRequest | ControlCredentialsRequest | AgentCredentialsRequest


class TcpAddress(Response, frozen=True, kw_only=True):
    """Where the broker takes MQTT. It wants certificates of agents that are newer than ``certificate_after_ms``."""

    host: str
    port: int
    tls: bool
    certificate_after_ms: int | None = None


class MqttCredentialsOut(Response, frozen=True, kw_only=True):
    """What to connect with, and the topics it is good for; for an agent also what is new of the cloud's keys."""

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
