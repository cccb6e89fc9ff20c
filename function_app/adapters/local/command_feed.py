"""Commands, Stop and setpoints to chosen agents, heard on the broker."""

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
from function_app.ports.command_feed import OnMessage

LIFETIME_S = 24 * 3600.0


class MqttCommandFeed:
    """``CommandFeed`` over MQTT, by a connection with rights of its own."""

    def __init__(self, *, host: str, port: int, access: BrokerAccess, tls: ssl.SSLContext | None = None) -> None:
        self._hear: OnMessage | None = None
        self._wanted: dict[tuple[str, str], tuple[str, ...]] = {}
        self._connection = MqttConnection(
            Broker(host=host, port=port, credentials=_credentials(access), tls=tls), receive=self._arrived
        )

    @property
    def up(self) -> bool:
        return not self._connection.trouble

    async def run(self, hear: OnMessage) -> None:
        self._hear = hear
        self._connection.start()
        try:
            await asyncio.Event().wait()
        finally:
            await self._connection.close()

    async def add(self, space: str, agent: str, listen: Sequence[str] = ()) -> None:
        self.drop(space, agent)
        wanted = (*_patterns(space, agent), *listen)
        fresh = [pattern for pattern in dict.fromkeys(wanted) if not self._heard(pattern)]
        self._wanted[space, agent] = wanted
        await self._connection.subscribe(fresh)

    def drop(self, space: str, agent: str) -> None:
        gone = self._wanted.pop((space, agent), ())
        self._connection.unsubscribe([pattern for pattern in gone if not self._heard(pattern)])

    def _heard(self, pattern: str) -> bool:
        return any(pattern in wanted for wanted in self._wanted.values())

    def _arrived(self, message: MQTTMessage) -> None:
        # An order that a broker kept is not an order of now.
        if self._hear is not None and not message.retain:
            self._hear(message.topic, bytes(message.payload))


def _patterns(space: str, agent: str) -> tuple[str, ...]:
    return (
        topics.device(space, agent, ANY, topics.CMD),
        topics.device(space, agent, ANY, topics.STOP),
        topics.device(space, agent, ANY, topics.CTL, ANY),
        topics.conn(space, agent),
    )


def _credentials(access: BrokerAccess) -> Callable[[], Awaitable[ServiceCredentials]]:
    async def issued() -> ServiceCredentials:
        grant = grants.gateway_grant(
            client_id=f"speaker-{secrets.token_hex(8)}", token_id=secrets.token_hex(16), lifetime_s=LIFETIME_S
        )
        given = await access.issue(grant)
        return ServiceCredentials(grant.client_id, given.username, given.password, float(grant.expires_at))

    return issued
