"""``mqtt/credentials``."""

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import Answer, Epoch, Moment, Request


class WatchRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="watch"):
    """To see every device and to stop those one may operate."""


class ControlRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="control"):
    """To send setpoints under a lease."""

    device: Id
    epoch: Epoch


class AgentRequest(Request, frozen=True, kw_only=True, tag_field="purpose", tag="agent"):
    """To speak for an agent's own devices."""


MqttRequest = WatchRequest | ControlRequest | AgentRequest


class TcpAddress(Answer, frozen=True, kw_only=True):
    """Where the broker takes MQTT. It wants certificates of agents that are newer than ``certificate_after_ms``."""

    host: str
    port: int
    tls: bool
    certificate_after_ms: int | None = None


class MqttCredentialsOut(Answer, frozen=True, kw_only=True):
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
