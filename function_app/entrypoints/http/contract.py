"""What travels over HTTP, as structs: they read requests, write answers, and are the OpenAPI document's schemas.

Requests refuse unknown fields and numbers that are not finite. ``*_at`` are RFC 3339 in UTC.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from device_agent.protocol.messages import Id, Joint, Label, State, Text
from function_app.services.start_action import Asked

Moment = Annotated[str, Meta(description="RFC 3339, UTC, with milliseconds", examples=["2026-01-31T12:00:00.000Z"])]
Epoch = Annotated[int, Meta(ge=1, le=2**53)]
DeviceName = Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{1,32}$")]
Name = Annotated[str, Meta(min_length=1, max_length=200)]
LeaseMs = Annotated[int, Meta(ge=1_000, le=600_000)]
WaitMs = Annotated[int, Meta(ge=0, le=30_000)]


class _Request(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Read strictly."""


class _Answer(Struct, frozen=True, kw_only=True):
    """Written as it is."""


# ---------------------------------------------------------------- errors


class Problem(_Answer, frozen=True, kw_only=True):
    """RFC 9457. ``type`` ends in a stable code; further members depend on it."""

    type: str
    title: str
    status: int
    detail: str


# ---------------------------------------------------------------- accounts


class SignInRequest(_Request, frozen=True, kw_only=True):
    """The token of a one-time link."""

    link: Annotated[str, Meta(min_length=1, max_length=200)]


class AccountRef(_Answer, frozen=True, kw_only=True):
    """An account, as others see it."""

    id: str
    name: str


class SignedIn(_Answer, frozen=True, kw_only=True):
    """A new sign-in session."""

    access_token: str
    token_type: Literal["Bearer"]
    expires_in_s: int
    account: AccountRef
    session: str


class Me(_Answer, frozen=True, kw_only=True):
    """Who asks."""

    id: str
    name: str
    session: str


class SpaceOut(_Answer, frozen=True, kw_only=True):
    """A space."""

    id: str
    name: str


class SpaceList(_Answer, frozen=True, kw_only=True):
    """Spaces."""

    items: tuple[SpaceOut, ...]
    cursor: str | None


# ---------------------------------------------------------------- agents


class DeviceIn(_Request, frozen=True, kw_only=True):
    """One device behind an agent."""

    name: DeviceName
    kind: Label
    robot_type: Id
    label: Label


class EnrollRequest(_Request, frozen=True, kw_only=True):
    """An agent introduces itself; the request's token is signed by the key that it names."""

    name: Name
    public_key: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{43}$")]
    software: Label
    devices: Annotated[tuple[DeviceIn, ...], Meta(min_length=1, max_length=64)]


class Enrolled(_Answer, frozen=True, kw_only=True):
    """``claim_code`` is null once the agent is claimed."""

    agent: str
    claim_code: str | None
    expires_at: Moment | None
    expires_in_s: int


class KeyOut(_Answer, frozen=True, kw_only=True):
    """A public key (Ed25519, base64url) and its id."""

    id: str
    public: str


class EnrollmentState(_Answer, frozen=True, kw_only=True):
    """Whether an agent is claimed, and the keys whose commands it is to obey."""

    agent: str
    state: Literal["waiting", "claimed"]
    space: str | None
    account: AccountRef | None
    keys: tuple[KeyOut, ...]


class ClaimRequest(_Request, frozen=True, kw_only=True):
    """The code that an agent shows, and the space it shall be in (default: the first)."""

    code: Annotated[str, Meta(min_length=1, max_length=40)]
    space: Id | None = None


class AgentOut(_Answer, frozen=True, kw_only=True):
    """An agent of the account."""

    id: str
    name: str
    software: str
    space: str
    devices: tuple[str, ...]
    claimed_at: Moment


class AgentList(_Answer, frozen=True, kw_only=True):
    """Agents."""

    items: tuple[AgentOut, ...]
    cursor: str | None


# ---------------------------------------------------------------- devices


class LeaseOut(_Answer, frozen=True, kw_only=True):
    """Who controls a device."""

    holder: str
    epoch: int
    expires_at: Moment
    mine: bool


class DeviceOut(_Answer, frozen=True, kw_only=True):
    """A device. ``state`` is the newest ``state`` message of the device."""

    id: str
    name: str
    label: str
    kind: str
    robot_type: str
    agent: str
    space: str
    role: Literal["owner", "operator", "viewer"]
    topic: str
    online: bool
    last_seen_at: Moment | None
    state: State | None
    lease: LeaseOut | None


class DeviceList(_Answer, frozen=True, kw_only=True):
    """Devices, agent by agent."""

    items: tuple[DeviceOut, ...]
    cursor: str | None


class Claimed(_Answer, frozen=True, kw_only=True):
    """What was claimed."""

    agent: str
    space: str
    devices: tuple[DeviceOut, ...]


class LeaseRequest(_Request, frozen=True, kw_only=True):
    """Without ``epoch``: take. With it: renew that epoch."""

    lease_ms: LeaseMs = 30_000
    epoch: Epoch | None = None
    wait_ms: WaitMs = 1_000


class LeaseGranted(_Answer, frozen=True, kw_only=True):
    """The caller's lease. ``confirmed``: the device has acknowledged it."""

    epoch: int
    holder: str
    expires_at: Moment
    lease_ms: int
    confirmed: bool


class LeaseNow(_Answer, frozen=True, kw_only=True):
    """The live lease of a device, if any."""

    lease: LeaseOut | None


class StopRequest(_Request, frozen=True, kw_only=True):
    """Why."""

    reason: Text = ""


class Confirmed(_Answer, frozen=True, kw_only=True):
    """Whether the device has confirmed within a second."""

    confirmed: bool


# ---------------------------------------------------------------- actions


class ActionRequest(_Request, frozen=True, kw_only=True):
    """What to run. Without ``epoch`` the action brings a lease for its own time."""

    request: Asked
    epoch: Epoch | None = None
    ttl_ms: Annotated[int, Meta(ge=1, le=86_400_000)] = 10_000
    timeout_ms: Annotated[int, Meta(ge=1_000, le=86_400_000)] = 300_000
    wait_ms: WaitMs = 0
    wait_for: Literal["started", "done"] = "started"


class ReasonOut(_Answer, frozen=True, kw_only=True):
    """Why an action ended as it did."""

    code: str
    message: str


class ActionOut(_Answer, frozen=True, kw_only=True):
    """An action. ``times``: ``<status>_ms`` → milliseconds since 1970."""

    id: str
    device: str
    request: dict[str, Any]
    status: Literal["created", "published", "received", "accepted", "started", "done", "failed", "expired", "cancelled"]
    epoch: int
    who: str
    created_at: Moment
    deadline_at: Moment
    times: dict[str, int]
    reason: ReasonOut | None
    progress: float | None
    output: str
    result: dict[str, Any]


class ActionList(_Answer, frozen=True, kw_only=True):
    """Actions, newest first."""

    items: tuple[ActionOut, ...]
    cursor: str | None


# ---------------------------------------------------------------- robot types, movements


class RobotTypeOut(_Answer, frozen=True, kw_only=True):
    """What every robot of one type has in common."""

    type: str
    label: str
    kind: str
    version: int
    description: str
    joints: tuple[Joint, ...]
    capabilities: tuple[str, ...]


class RobotTypeList(_Answer, frozen=True, kw_only=True):
    """Robot types."""

    items: tuple[RobotTypeOut, ...]
    cursor: str | None


class MovementOut(_Answer, frozen=True, kw_only=True):
    """A movement's newest version."""

    name: str
    description: str
    version: int
    sha256: str
    updated_at: Moment
    built_in: bool


class MovementSource(_Answer, frozen=True, kw_only=True):
    """A movement's newest version, with its script."""

    name: str
    description: str
    version: int
    sha256: str
    updated_at: Moment
    built_in: bool
    source: str


class MovementList(_Answer, frozen=True, kw_only=True):
    """Movements by name."""

    items: tuple[MovementOut, ...]
    cursor: str | None


class MovementRequest(_Request, frozen=True, kw_only=True):
    """A script. Without a description the first line of its docstring serves."""

    source: Annotated[str, Meta(min_length=1, max_length=64_000)]
    description: Label | None = None


# ---------------------------------------------------------------- broker


class WatchRequest(_Request, frozen=True, kw_only=True, tag_field="purpose", tag="watch"):
    """To see every device and to stop those one may operate."""


class ControlRequest(_Request, frozen=True, kw_only=True, tag_field="purpose", tag="control"):
    """To send setpoints under a lease."""

    device: Id
    epoch: Epoch


class AgentRequest(_Request, frozen=True, kw_only=True, tag_field="purpose", tag="agent"):
    """To speak for an agent's own devices."""


MqttRequest = WatchRequest | ControlRequest | AgentRequest


class TcpAddress(_Answer, frozen=True, kw_only=True):
    """Where the broker takes MQTT."""

    host: str
    port: int


class MqttCredentialsOut(_Answer, frozen=True, kw_only=True):
    """What to connect with, and the topics it is good for."""

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


class HealthOut(_Answer, frozen=True, kw_only=True):
    """``ok``, or a sentence, for each thing the functions need."""

    status: Literal["ok", "degraded"]
    version: str
    tables: str
    broker: str
