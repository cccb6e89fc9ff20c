"""Short-lived broker credentials, for exactly what their holder may do."""

from dataclasses import dataclass

from device_agent.protocol import grants, topics
from device_agent.protocol.grants import Grant
from function_app.domain import lease as rules
from function_app.domain.accounts import Identity
from function_app.domain.devices import Agent
from function_app.domain.ids import new_id
from function_app.domain.problems import broker_unavailable
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError, Credentials
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.audit import Audit
from function_app.services.control import read_lease
from function_app.services.devices import Devices, require_claimed, require_operator
from function_app.services.identity import principal
from function_app.services.lease import control_client

WATCH_S = 15 * 60
AGENT_S = 3600
CONTROL_MIN_S = 60

_WATCHED = (topics.DESC, topics.STATE, topics.EVENT, topics.ACK)
_WATCHED_NAMED = ((topics.DESC, topics.TWIN), (topics.TELE, topics.ANY), (topics.CAM, topics.ANY))


@dataclass(frozen=True, slots=True)
class Issued:
    """Credentials, and the topics to use with them."""

    client_id: str
    credentials: Credentials
    expires_ms: int
    lifetime_s: int
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]


class MqttCredentials:
    """Issues broker credentials."""

    def __init__(self, *, tables: Tables, devices: Devices, access: BrokerAccess, audit: Audit, clock: Clock) -> None:
        self._audit = audit
        self._tables = tables
        self._devices = devices
        self._access = access
        self._clock = clock

    async def watch(self, who: Identity) -> Issued:
        """To see every device of the account, and to stop those it may operate.

        A space belongs to one account, so what the broker is told is said by space and stays small however many
        devices there are; the answer names each topic.

        Raises:
            Problem: ``broker-unavailable``.
        """
        devices = await self._devices.all(who)
        spaces = sorted({device.space for device in devices})
        publish = tuple(f"{device.topic}/{topics.STOP}" for device in devices if device.role.may_operate)
        subscribe: list[str] = []
        for space, agent in sorted({(device.space, device.agent) for device in devices}):
            subscribe.append(topics.conn(space, agent))
        for device in devices:
            subscribe += [f"{device.topic}/{kind}" for kind in _WATCHED]
            subscribe += [f"{device.topic}/{kind}/{name}" for kind, name in _WATCHED_NAMED]
        anyone = topics.ANY
        granted_subscribe: list[str] = []
        for space in spaces:
            granted_subscribe.append(topics.conn(space, anyone))
            granted_subscribe += [topics.device(space, anyone, anyone, kind) for kind in _WATCHED]
            granted_subscribe += [topics.device(space, anyone, anyone, kind, name) for kind, name in _WATCHED_NAMED]
        grant = Grant(
            principal=principal(who),
            client_id=f"w-{who.session}-{new_id(10)}",
            publish=tuple(topics.device(space, anyone, anyone, topics.STOP) for space in spaces),
            subscribe=tuple(granted_subscribe),
            token_id=new_id(),
            expires_at=self._clock.now_ms() // 1000 + WATCH_S,
        )
        return await self._issue(grant, WATCH_S, publish, tuple(subscribe))

    async def control(self, who: Identity, device_id: str, epoch: int) -> Issued:
        """To send setpoints under one epoch of a lease.

        Raises:
            Problem: ``device-unknown``, ``forbidden``, ``lease-lost``, ``broker-unavailable``.
        """
        device = await self._devices.get(who, device_id)
        now_ms = self._clock.now_ms()
        async with self._audit.refusals(device, who, "steer"):
            require_operator(device)
            lease = rules.hold(await read_lease(self._tables, device), who, epoch=epoch, now_ms=now_ms)
        lifetime_s = max(CONTROL_MIN_S, lease.lease_ms // 1000)
        publish = (f"{device.topic}/{topics.CTL}/{epoch}",)
        grant = Grant(
            principal=principal(who),
            client_id=control_client(device.id, epoch),
            publish=publish,
            subscribe=(),
            token_id=new_id(),
            expires_at=now_ms // 1000 + lifetime_s,
        )
        return await self._issue(grant, lifetime_s, publish, ())

    async def agent(self, agent: Agent) -> Issued:
        """To speak for an agent's own devices and hear what is addressed to them.

        It may also hear what its space measures; which of that it does, its own configuration says.

        Raises:
            Problem: ``agent-unclaimed``, ``broker-unavailable``.
        """
        space = require_claimed(agent)
        grant = grants.agent_grant(space, agent.id, token_id=new_id(), lifetime_s=AGENT_S)
        return await self._issue(grant, AGENT_S, grant.publish, grants.agent_orders(space, agent.id))

    async def _issue(
        self, grant: Grant, lifetime_s: int, publish: tuple[str, ...], subscribe: tuple[str, ...]
    ) -> Issued:
        try:
            credentials = await self._access.issue(grant)
        except BrokerAccessError as error:
            raise broker_unavailable(f"{error}.") from error
        return Issued(grant.client_id, credentials, grant.expires_at * 1000, lifetime_s, publish, subscribe)
