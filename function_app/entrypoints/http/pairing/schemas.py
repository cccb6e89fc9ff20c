"""Requests and responses of agents."""

from typing import Annotated, Literal

from msgspec import Meta

from device_agent.protocol import Id, Label
from function_app.entrypoints.http.devices.schemas import DeviceOut
from function_app.entrypoints.http.framework.schemas import AccountRef, DeviceName, Moment, Name, Request, Response


class DeviceIn(Request, frozen=True, kw_only=True):
    """One device behind an agent."""

    name: DeviceName
    kind: Label
    robot_type: Id
    label: Label


class EnrollRequest(Request, frozen=True, kw_only=True):
    """An agent introduces itself; the request's token is signed by the key that it names."""

    name: Name
    public_key: Annotated[str, Meta(pattern="^[A-Za-z0-9_-]{43}$")]
    software: Label
    devices: Annotated[tuple[DeviceIn, ...], Meta(min_length=1, max_length=64)]
    transport: Annotated[
        Literal["mqtt", "http", "xmpp"], Meta(description="How it hears commands: by the broker, or by asking")
    ] = "mqtt"


class EnrollmentOut(Response, frozen=True, kw_only=True):
    """``claim_code`` is null once the agent is claimed."""

    agent: str
    claim_code: str | None
    expires_at: Moment | None
    expires_in_s: int


class SigningKeyOut(Response, frozen=True, kw_only=True):
    """A public key (Ed25519, base64url), its id and place in their order; it counts until ``until_ms`` (0: on)."""

    id: str
    public: str
    serial: int
    until_ms: int


class EnrollmentState(Response, frozen=True, kw_only=True):
    """Whether an agent is claimed, and the keys whose commands it is to obey.

    ``key_statements`` lead from a key that is pinned already to the newest; ``signing_key`` signs commands now.
    """

    agent: str
    state: Literal["waiting", "claimed"]
    space: str | None
    account: AccountRef | None
    keys: tuple[SigningKeyOut, ...]
    key_statements: tuple[str, ...]
    signing_key: str


class CertificateRequest(Request, frozen=True, kw_only=True):
    """PKCS 10 in PEM, for a key on P-256 that has signed it."""

    request: Annotated[str, Meta(min_length=1, max_length=4096)]


class CertificateOut(Response, frozen=True, kw_only=True):
    """What the agent is to show to the broker, in PEM."""

    chain: str
    expires_at: Moment


class ClaimRequest(Request, frozen=True, kw_only=True):
    """The code that an agent shows, and the space it shall be in (default: the first)."""

    code: Annotated[str, Meta(min_length=1, max_length=40)]
    space: Id | None = None


class MoveAgentRequest(Request, frozen=True, kw_only=True):
    """The space to move an agent to, one of the account's."""

    space: Id


class AgentOut(Response, frozen=True, kw_only=True):
    """An agent of the account."""

    id: str
    name: str
    software: str
    space: str
    devices: tuple[str, ...]
    transport: Literal["mqtt", "http", "xmpp"]
    claimed_at: Moment


class AgentList(Response, frozen=True, kw_only=True):
    """Agents."""

    items: tuple[AgentOut, ...]
    cursor: str | None


class ClaimOut(Response, frozen=True, kw_only=True):
    """What was claimed."""

    agent: str
    space: str
    devices: tuple[DeviceOut, ...]
