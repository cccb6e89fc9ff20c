"""Requests and responses of agents."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from device_agent.protocol import KINDS, PROTOCOL, Capabilities, Id, Label, VersionRange
from function_app.entrypoints.http.devices.schemas import DeviceOut
from function_app.entrypoints.http.framework.schemas import (
    AccountRef,
    AgentRequest,
    DeviceName,
    LabelledRequest,
    Moment,
    Name,
    Request,
    Response,
)


class DeviceIn(LabelledRequest, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """One device behind an agent."""

    labels: ClassVar = ("kind", "label")
    name: DeviceName
    kind: Label
    robot_type: Id
    label: Label


class EnrollRequest(LabelledRequest, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """An agent with its devices. ``public_key`` must verify the bearer token.

    ``protocol``: versions of the wire contract that it supports. ``capabilities``: kinds of request that it accepts.
    """

    labels: ClassVar = ("name", "software")
    name: Name
    public_key: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{43}$")]
    software: Label
    devices: Annotated[tuple[DeviceIn, ...], Meta(min_length=1, max_length=64)]
    transport: Annotated[
        Literal["mqtt", "http", "xmpp"],
        Meta(description="How the agent receives commands: MQTT broker, HTTP polling or XMPP"),
    ] = "mqtt"
    protocol: VersionRange = VersionRange()
    capabilities: Capabilities = ()


class EnrollmentOut(Response, frozen=True, kw_only=True):
    """An enrolled agent. ``claim_code`` is null if the agent is claimed.

    ``protocol``: versions that the server supports; the highest common one is used. ``capabilities``: kinds of request
    that the server can send.
    """

    agent: str
    claim_code: str | None
    expires_at: Moment | None
    expires_in_s: int
    protocol: VersionRange = PROTOCOL
    capabilities: tuple[str, ...] = KINDS


class SigningKeyOut(Response, frozen=True, kw_only=True):
    """A public key (Ed25519, base64url).

    ``serial`` increases with each rotation. ``until_ms``: expiry time [ms since 1970]; 0: does not expire.
    """

    id: str
    public: str
    serial: int
    until_ms: int


class EnrollmentState(Response, frozen=True, kw_only=True):
    """Whether an agent is claimed, and the keys whose commands it must accept.

    ``key_statements`` is the chain of signed rotations up to the newest key. ``signing_key`` signs commands now.
    """

    agent: str
    state: Literal["waiting", "claimed"]
    space: str | None
    account: AccountRef | None
    keys: tuple[SigningKeyOut, ...]
    key_statements: tuple[str, ...]
    signing_key: str


class CertificateRequest(AgentRequest, frozen=True, kw_only=True):
    """A certificate signing request (PKCS #10 in PEM) for a P-256 key."""

    request: Annotated[str, Meta(min_length=1, max_length=4096)]


class CertificateOut(Response, frozen=True, kw_only=True):
    """The agent's certificate chain for the broker (PEM)."""

    chain: str
    expires_at: Moment


class ClaimRequest(Request, frozen=True, kw_only=True):
    """The claim code that the agent displays. ``space``: where to put the agent; null: the account's first space."""

    code: Annotated[str, Meta(min_length=1, max_length=40)]
    space: Id | None = None


class MoveAgentRequest(Request, frozen=True, kw_only=True):
    """The new space, which the account must own."""

    space: Id


class AgentOut(Response, frozen=True, kw_only=True):
    """An agent of the account. ``devices``: names of its devices."""

    id: str
    name: str
    software: str
    space: str
    devices: tuple[str, ...]
    transport: Literal["mqtt", "http", "xmpp"]
    claimed_at: Moment


class AgentList(Response, frozen=True, kw_only=True):
    """Agents of the account."""

    items: tuple[AgentOut, ...]
    cursor: str | None


class ClaimOut(Response, frozen=True, kw_only=True):
    """The claimed agent and its devices."""

    agent: str
    space: str
    devices: tuple[DeviceOut, ...]
