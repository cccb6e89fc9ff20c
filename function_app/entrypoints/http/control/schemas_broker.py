"""``mqtt/credentials``."""

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import Epoch, Moment, Request, Response


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
