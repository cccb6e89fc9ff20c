"""Short-lived broker credentials with minimal permissions."""

from collections.abc import Awaitable
from dataclasses import dataclass, field, replace

from device_agent.protocol import topics
from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from function_app.domain.common.ids import new_id
from function_app.domain.common.problems import Problem, broker_unavailable, busy_store
from function_app.domain.control import lease as rules
from function_app.domain.devices.devices import Agent, Device
from function_app.domain.identity.accounts import Identity
from function_app.ports.broker_access import BrokerAccess, BrokerAccessError, Credentials
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.control.control_events import ControlEvents
from function_app.services.control.fencing import control_client
from function_app.services.devices.control_rows import read_lease
from function_app.services.devices.device_access import DeviceAccess, require_claimed, require_operator
from function_app.services.identity.authenticator import principal, viewer_principal

WATCH_S = 15 * 60
AGENT_S = 3600
CONTROL_MIN_S = 60
TOPIC_BYTES = 10_000
"""Filters in one grant [bytes]: signed and in base64 they fit into the 16 KiB of a CONNECT."""


@dataclass(frozen=True, slots=True)
class IssuedCredentials:
    """Credentials, and the topics that they allow.

    ``confirmations``: topics on which an agent receives confirmations of stored messages.
    """

    client_id: str
    credentials: Credentials
    expires_ms: int
    lifetime_s: int
    publish: tuple[str, ...]
    subscribe: tuple[str, ...]
    confirmations: str | None = None


class MqttCredentials:
    """Issues broker credentials."""

    def __init__(
        self,
        *,
        tables: Tables,
        devices: DeviceAccess,
        access: BrokerAccess,
        control_events: ControlEvents,
        clock: Clock,
    ) -> None:
        self._control_events = control_events
        self._tables = tables
        self._devices = devices
        self._access = access
        self._clock = clock

    async def watch(self, caller: Identity) -> IssuedCredentials:
        """Credentials to view all visible devices, and to stop those that the caller may operate.

        For shared spaces the grant contains wildcard filters for the space, so its size does not depend on the number
        of devices. Devices shared individually are listed by topic. The response lists each topic. The credentials
        expire with the first share, session or API key that they depend on. Raises ``broker-unavailable`` or ``busy``.
        """
        devices = await self._devices.all(caller)
        issued = await self._watch(caller, devices)
        if any(device.owner != caller.account for device in devices) and _rights(
            await self._devices.all(caller)
        ) != _rights(devices):
            # A share ended concurrently: its connections were closed before these credentials existed.
            await self._revoke(issued)
            raise busy_store()
        await self._revoke_unless(issued, self._devices.require_key(caller))
        return issued

    async def _watch(self, caller: Identity, devices: list[Device]) -> IssuedCredentials:
        watched = _view_filters(devices, self._access, author=caller.account)
        seen = watched.devices
        now_ms = self._clock.now_ms()
        ends_ms = min([now_ms + WATCH_S * 1000, caller.until_ms, *(device.until_ms for device in seen)])
        grant = Grant(
            principal=viewer_principal(caller),
            client_id=f"w-{caller.session}-{new_id(10)}",
            publish=tuple(watched.publish),
            subscribe=tuple(watched.subscribe),
            token_id=new_id(),
            expires_at=max(now_ms // 1000 + 1, ends_ms // 1000),
        )
        subscribe = [topics.conn(space, agent) for space, agent in sorted({(one.space, one.agent) for one in seen})]
        for device in seen:
            subscribe += grants.device_subscriptions(device.space, device.agent, device.name)
        lifetime_s = max(1, (ends_ms - now_ms) // 1000)
        return await self._issue(grant, lifetime_s, tuple(watched.stops), tuple(dict.fromkeys(subscribe)))

    async def _revoke(self, issued: IssuedCredentials) -> None:
        try:
            await self._access.revoke(client_id=issued.client_id)
        except BrokerAccessError as error:
            raise broker_unavailable(f"{error}.") from error

    async def control(self, caller: Identity, device_id: str, epoch: int) -> IssuedCredentials:
        """Credentials to send setpoints in one epoch.

        Raises ``device-unknown``, ``forbidden``, ``streaming-unavailable``, ``lease-lost`` or ``broker-unavailable``.
        """
        device, lease = await self.require_control(caller, device_id, epoch)
        now_ms = self._clock.now_ms()
        # Longer than the lease, which may be renewed, but not longer than the permission.
        lifetime_s = min(max(CONTROL_MIN_S, lease.lease_ms // 1000), max(1, (device.until_ms - now_ms) // 1000))
        publish = (f"{device.topic}/{topics.CTL}/{epoch}",)
        grant = Grant(
            principal=principal(caller),
            client_id=control_client(device.id, epoch),
            publish=publish,
            subscribe=(),
            token_id=new_id(),
            expires_at=now_ms // 1000 + lifetime_s,
        )
        issued = await self._issue(grant, lifetime_s, publish, ())
        await self._revoke_unless(issued, self._devices.require_still_allowed(caller, device))
        return issued

    async def require_control(self, caller: Identity, device_id: str, epoch: int) -> tuple[Device, rules.Lease]:
        """The device and the caller's lease, if the caller may send setpoints in this epoch.

        Raises ``device-unknown``, ``forbidden``, ``streaming-unavailable`` or ``lease-lost``.
        """
        device = await self._devices.get(caller, device_id)
        now_ms = self._clock.now_ms()
        async with self._control_events.recording_rejections(device, caller, "steer"):
            require_operator(device)
            if not device.streaming:
                raise Problem(
                    "streaming-unavailable",
                    409,
                    "The device accepts no setpoints",
                    "The agent of this device polls over HTTP, so setpoints do not reach it. Use actions, or set the "
                    "agent's transport to mqtt.",
                )
            lease = rules.require_held(await read_lease(self._tables, device), caller, epoch=epoch, now_ms=now_ms)
        return device, lease

    async def _revoke_unless(self, issued: IssuedCredentials, still: Awaitable[object]) -> None:
        """Revoke credentials whose permission ended while they were issued."""
        try:
            await still
        except Problem:
            await self._revoke(issued)
            raise

    async def agent(self, agent: Agent) -> IssuedCredentials:
        """Credentials of an agent: publish for its devices and receive their commands.

        They also allow reading the measurements of its space; its configuration selects which.
        Raises ``agent-unclaimed`` or ``broker-unavailable``.
        """
        space = require_claimed(agent)
        grant = grants.agent_grant(space, agent.id, token_id=new_id(), lifetime_s=AGENT_S)
        issued = await self._issue(grant, AGENT_S, grant.publish, grants.agent_command_topics(space, agent.id))
        return replace(issued, confirmations=grants.agent_confirmations(space, agent.id))

    async def _issue(
        self, grant: Grant, lifetime_s: int, publish: tuple[str, ...], subscribe: tuple[str, ...]
    ) -> IssuedCredentials:
        try:
            credentials = await self._access.issue(grant)
        except BrokerAccessError as error:
            raise broker_unavailable(f"{error}.") from error
        return IssuedCredentials(grant.client_id, credentials, grant.expires_at * 1000, lifetime_s, publish, subscribe)


@dataclass(slots=True)
class _ViewFilters:
    """The filters of one connection, and the devices that they cover.

    Attributes:
        publish: Filters.
        subscribe: Filters.
        devices: Visible devices.
        stops: Stop topics of the devices that may be stopped.
    """

    publish: list[str] = field(default_factory=list)
    subscribe: list[str] = field(default_factory=list)
    devices: list[Device] = field(default_factory=list)
    stops: list[str] = field(default_factory=list)

    def add(self, stop_filters: list[str], view_filters: tuple[str, ...], access: BrokerAccess) -> bool:
        """Add filters; return whether they fit."""
        publish = list(dict.fromkeys([*self.publish, *stop_filters]))
        subscribe = list(dict.fromkeys([*self.subscribe, *view_filters]))
        size = sum(len(pattern) + 3 for pattern in (*publish, *subscribe))
        if size > TOPIC_BYTES or not access.accepts(publish, subscribe):
            return False
        self.publish, self.subscribe = publish, subscribe
        return True


def _view_filters(devices: list[Device], access: BrokerAccess, *, author: str) -> _ViewFilters:
    """The filters to view these devices and to stop them as ``author``, and the devices that fit.

    Whole spaces come first. All filters are part of one CONNECT, whose size brokers limit, so further devices are left
    out. Share the space instead of many single devices.
    """
    result = _ViewFilters()
    covered: set[str] = set()
    for space, role in sorted({(device.space, device.space_role) for device in devices if device.space_role}):
        stop_filters = [topics.device(space, topics.ANY, topics.ANY, topics.STOP, author)] if role.may_operate else []
        if not result.add(stop_filters, grants.device_subscriptions(space, topics.ANY, topics.ANY), access):
            break
        members = [device for device in devices if device.space == space and device.space_role]
        result.devices += members
        covered |= {device.id for device in members}
        result.stops += [_stop(device, author) for device in members if role.may_operate]
    stoppable = set(result.stops)
    for device in devices:
        stop_filters = [_stop(device, author)] if device.role.may_operate else []
        stop_filters = [topic for topic in stop_filters if topic not in stoppable]
        view_filters = (
            () if device.id in covered else grants.device_subscriptions(device.space, device.agent, device.name)
        )
        if not stop_filters and not view_filters:
            continue
        if not result.add(stop_filters, view_filters, access):
            break
        result.stops += stop_filters
        result.devices += [device] if view_filters else []
    return result


def _stop(device: Device, author: str) -> str:
    return f"{device.topic}/{topics.STOP}/{author}"


def _rights(devices: list[Device]) -> set[tuple[object, ...]]:
    return {(device.id, device.topic, device.role, device.space_role, device.until_ms) for device in devices}
