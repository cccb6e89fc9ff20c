"""``xmpp/credentials``, ``xmpp/verify``."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.control.schemas_broker import AgentCredentialsRequest, ViewCredentialsRequest
from function_app.entrypoints.http.framework.schemas import Moment, Request, Response

XmppCredentialsRequest = ViewCredentialsRequest | AgentCredentialsRequest


class XmppCredentialsOut(Response, frozen=True, kw_only=True):
    """Where to connect, as whom, and with whom to speak.

    ``cloud`` is the bare JID of whoever speaks for the cloud.
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
    key_statements: tuple[str, ...] = ()
    signing_key: str = ""


class XmppVerifyRequest(Request, frozen=True, kw_only=True):
    """What somebody gave at a login."""

    user: Annotated[str, Meta(min_length=1, max_length=64)]
    password: Annotated[str, Meta(min_length=1, max_length=4096)]


class XmppContactOut(Response, frozen=True, kw_only=True):
    """Somebody whom the user knows, and is known to."""

    user: str
    name: str


class XmppIdentityOut(Response, frozen=True, kw_only=True):
    """Who it is, how long the connection may last, and whom they know."""

    user: str
    name: str
    kind: Literal["agent", "account", "cloud"]
    lifetime_s: int
    contacts: tuple[XmppContactOut, ...]
