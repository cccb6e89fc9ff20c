"""Subscribes to commands, Stop and setpoints for chosen agents."""

import asyncio
import secrets
import ssl
from collections.abc import Awaitable, Callable, Sequence

from paho.mqtt.client import MQTTMessage

from device_agent.protocol import topics
from device_agent.protocol.security import grants
from device_agent.protocol.topics import ANY
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from function_app.ports.broker_access import BrokerAccess, ServiceCredentials
from function_app.ports.feeds import OnMessage

LIFETIME_S = 24 * 3600.0


class MqttCommandFeed:
    """``CommandFeed`` over a separate MQTT connection with its own permissions."""

    def __init__(self, *, host: str, port: int, access: BrokerAccess, tls: ssl.SSLContext | None = None) -> None:
        self._on_message: OnMessage | None = None
        self._filters: dict[tuple[str, str], tuple[str, ...]] = {}
        self._connection = MqttConnection(
            Broker(host=host, port=port, credentials=_credentials(access), tls=tls), receive=self._receive
        )

    @property
    def up(self) -> bool:
        return not self._connection.problem

    async def run(self, on_message: OnMessage) -> None:
        self._on_message = on_message
        self._connection.start()
        try:
            await asyncio.Event().wait()
        finally:
            await self._connection.close()

    async def add(self, space: str, agent: str, listen: Sequence[str] = ()) -> None:
        self.drop(space, agent)
        filters = (*_patterns(space, agent), *listen)
        new = [pattern for pattern in dict.fromkeys(filters) if not self._is_used(pattern)]
        self._filters[space, agent] = filters
        await self._connection.subscribe(new)

    def drop(self, space: str, agent: str) -> None:
        removed = self._filters.pop((space, agent), ())
        self._connection.unsubscribe([pattern for pattern in removed if not self._is_used(pattern)])

    def _is_used(self, pattern: str) -> bool:
        return any(pattern in filters for filters in self._filters.values())

    def _receive(self, message: MQTTMessage) -> None:
        # A retained command is outdated.
        if self._on_message is not None and not message.retain:
            self._on_message(message.topic, bytes(message.payload))


def _patterns(space: str, agent: str) -> tuple[str, ...]:
    return (
        topics.device(space, agent, ANY, topics.CMD),
        topics.device(space, agent, ANY, topics.STOP, ANY),
        topics.device(space, agent, ANY, topics.CTL, ANY),
        topics.conn(space, agent),
    )


def _credentials(access: BrokerAccess) -> Callable[[], Awaitable[ServiceCredentials]]:
    async def issue() -> ServiceCredentials:
        grant = grants.gateway_grant(
            client_id=f"gateway-{secrets.token_hex(8)}", token_id=secrets.token_hex(16), lifetime_s=LIFETIME_S
        )
        issued = await access.issue(grant)
        return ServiceCredentials(grant.client_id, issued.username, issued.password, float(grant.expires_at))

    return issue
