"""Requests and responses of the polling transport and the XMPP server."""

from typing import Annotated, Literal

from msgspec import Meta, Raw

from function_app.entrypoints.http.control.schemas import (
    AgentCredentialsRequest,
    ControlCredentialsRequest,
    ViewCredentialsRequest,
)
from function_app.entrypoints.http.framework.schemas import AgentRequest, Moment, Request, Response


class CommandOut(Response, frozen=True, kw_only=True):
    """One command. ``payload``: the exact text of the MQTT message on ``topic``, so that its signature is valid."""

    id: str
    topic: str
    payload: str
    expires_at: Moment


class CommandList(Response, frozen=True, kw_only=True):
    """Commands that are not acknowledged: Stop first, then oldest first."""

    items: tuple[CommandOut, ...]


class AgentMessage(AgentRequest, frozen=True, kw_only=True):
    """One message, with topic and payload as in MQTT."""

    topic: Annotated[str, Meta(min_length=1, max_length=400)]
    payload: Raw


class MessagesRequest(AgentRequest, frozen=True, kw_only=True):
    """Messages in the order in which they were created."""

    messages: Annotated[tuple[AgentMessage, ...], Meta(min_length=1, max_length=500)]


class MessageResult(Response, frozen=True, kw_only=True):
    """The result for one message. A rejected message has a reason and must not be sent again."""

    status: Literal["stored", "rejected"]
    detail: str | None = None


class MessageResults(Response, frozen=True, kw_only=True):
    """One result for each message, in order."""

    results: tuple[MessageResult, ...]


XmppCredentialsRequest = ViewCredentialsRequest | ControlCredentialsRequest | AgentCredentialsRequest


class XmppCredentialsOut(Response, frozen=True, kw_only=True):
    """XMPP credentials and server address.

    ``cloud``: bare JID of the XMPP gateway. For an agent also the statements that rotate the server's signing keys.
    For control also ``token``, an access token that signs in at the gateway and expires with the password, and
    ``websocket_url``, the server's address for browsers.
    """

    jid: str
    password: str
    expires_at: Moment
    lifetime_s: int
    space: str | None
    cloud: str
    host: str
    port: int
    server_time_ms: int
    token: str = ""
    websocket_url: str = ""
    key_statements: tuple[str, ...] = ()
    signing_key: str = ""


class XmppVerifyRequest(Request, frozen=True, kw_only=True):
    """User and password of a login attempt."""

    user: Annotated[str, Meta(min_length=1, max_length=64)]
    password: Annotated[str, Meta(min_length=1, max_length=4096)]


class XmppContactOut(Response, frozen=True, kw_only=True):
    """A contact with a mutual subscription."""

    user: str
    name: str


class XmppIdentityOut(Response, frozen=True, kw_only=True):
    """The user, the maximum duration of the connection [s], and the contacts."""

    user: str
    name: str
    kind: Literal["agent", "account", "cloud"]
    lifetime_s: int
    contacts: tuple[XmppContactOut, ...]
