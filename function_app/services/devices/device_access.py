"""Device lookup and permissions: the only place that decides what an account may do with a device."""

import asyncio
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from device_agent.protocol import PROTOCOL, VersionRange, incompatibility, topics
from function_app.domain.common.ids import device_id, split_device
from function_app.domain.common.problems import Problem, forbidden, not_found, protocol_unsupported
from function_app.domain.control.lease import Lease
from function_app.domain.devices import access, devices
from function_app.domain.devices.access import OWNER_PERMISSIONS, Permissions, Share, device_target, space_target
from function_app.domain.devices.devices import Agent, Departure, Device, DeviceSpec, LastState, Link
from function_app.domain.identity.accounts import Account, Identity
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services.devices.control_rows import read_lease
from function_app.services.identity.session_status import current_identity
from function_app.services.storage import records

T = TypeVar("T")

_SHARED = "~shared:"
"""Prefix of cursors for shared devices, which follow the account's own devices."""


@dataclass(frozen=True, slots=True)
class DeviceView:
    """A device with its current state and the name of its owner."""

    device: Device
    owner_name: str
    online: bool
    last_seen_ms: int | None
    state: dict[str, Any] | None
    lease: Lease | None
    incompatible: str = ""


class DeviceAccess:
    """Looks up devices. A device that is neither owned by nor shared with the account does not exist for it."""

    def __init__(self, *, tables: Tables, clock: Clock) -> None:
        self._tables = tables
        self._clock = clock

    async def get(self, caller: Identity, device: str) -> Device:
        """One device. Raises ``device-unknown``."""
        result, _ = await self.get_with_link(caller, device)
        return result

    async def get_with_link(self, caller: Identity, device: str) -> tuple[Device, Link | None]:
        """One device and the last connection state of its agent, in one read. Raises ``device-unknown``."""
        result, link = await self.find_with_link(caller, device)
        if result is None:
            raise not_found("device", device)
        return result, link

    async def find_with_link(self, caller: Identity, device: str) -> tuple[Device | None, Link | None]:
        """Like ``get_with_link``, but returns ``None`` for a device that is not visible to ``caller``."""
        parts = split_device(device)
        if parts is None:
            return None, None
        page = await self._tables.query(records.AGENTS, parts[0], first="agent", last="link ", limit=2)
        rows = {row.key: row for row in page.rows}
        agent = records.read(rows["agent"], Agent) if "agent" in rows else None
        spec = agent.device(parts[1]) if agent else None
        if agent is None or spec is None:
            return None, None
        allowed = (await self._permissions(caller, agent, [spec.name])).get(spec.name)
        if allowed is None:
            return None, None
        return _device(agent, spec, allowed), _of(agent, rows, "link", Link)

    async def require_still_allowed(self, caller: Identity, device: Device) -> None:
        """Check, after a write for ``caller``, that the caller may still operate the device.

        Removing a share deletes the share first and then ends what depends on it. Using a share writes first and then
        calls this. So at least one of both sees the other. Changes of ownership change the pairing. API keys are
        checked in the same way. Raises ``device-unknown`` or ``forbidden``.
        """
        if caller.key:
            caller = await self.require_key(caller)
        if caller.key or device.owner != caller.account:
            require_operator(await self.get(caller, device.id))

    async def require_key(self, caller: Identity) -> Identity:
        """``caller`` with the current permissions of the API key; unchanged for a person. Raises ``forbidden``."""
        now = await self.current_identity(caller) if caller.key else caller
        if now is None:
            raise forbidden("This API key was revoked or has expired. Create a new one.")
        return now

    async def current_identity(self, caller: Identity) -> Identity | None:
        """``caller`` with current permissions; ``None`` if the key or session has ended."""
        return await current_identity(self._tables, caller, self._clock.now_ms())

    async def view(self, caller: Identity, device: str) -> DeviceView:
        """One device with its current state. Raises ``device-unknown``."""
        parts = split_device(device)
        if parts is not None:
            for view in await self.of_agent(caller, parts[0], only=parts[1]):
                return view
        raise not_found("device", device)

    async def views(self, caller: Identity, *, cursor: str | None, limit: int) -> tuple[list[DeviceView], str | None]:
        """All visible devices, in pages of up to ``limit`` agents. Raises ``cursor-invalid``."""
        ids, following = await self._agent_ids(caller, cursor, limit)
        result = await asyncio.gather(*(self.of_agent(caller, agent) for agent in ids))
        return [view for views in result for view in views], following

    async def all(self, caller: Identity) -> list[Device]:
        """All visible devices, without their current state."""
        ids = [*await self._all_agent_ids(caller.account), *await self._shared_agent_ids(caller.account)]
        visible = await asyncio.gather(*(self._visible_devices(caller, agent) for agent in ids))
        return [device for devices_ in visible for device in devices_]

    async def agents(self, caller: Identity, *, cursor: str | None, limit: int) -> tuple[list[Agent], str | None]:
        """The account's own agents with at least one device visible to ``caller``. Raises ``cursor-invalid``."""
        ids, following = await self._own_agent_ids(caller.account, cursor, limit)
        rows = await asyncio.gather(*(self._tables.get(records.AGENTS, agent, "agent") for agent in ids))
        agents = [records.read(row, Agent) for row in rows if row is not None]
        own = [agent for agent in agents if agent.account == caller.account]
        return [agent for agent in own if not agent.devices or await self._permissions(caller, agent)], following

    async def _visible_devices(self, caller: Identity, agent_id: str) -> list[Device]:
        row = await self._tables.get(records.AGENTS, agent_id, "agent")
        if row is None:
            return []
        agent = records.read(row, Agent)
        allowed = await self._permissions(caller, agent)
        return [_device(agent, spec, allowed[spec.name]) for spec in agent.devices if spec.name in allowed]

    async def _agent_ids(self, caller: Identity, cursor: str | None, limit: int) -> tuple[list[str], str | None]:
        """The account's own agents, then those with shared devices."""
        own: list[str] = []
        after = ""
        if cursor is not None and cursor.startswith(_SHARED):
            after = cursor.removeprefix(_SHARED)
        else:
            own, following = await self._own_agent_ids(caller.account, cursor, limit)
            if following is not None:
                return own, following
        shared = [agent for agent in await self._shared_agent_ids(caller.account) if agent > after]
        selected = shared[: limit - len(own)]
        last = selected[-1] if selected else after
        return own + selected, f"{_SHARED}{last}" if len(shared) > len(selected) else None

    async def _own_agent_ids(self, account: str, cursor: str | None, limit: int) -> tuple[list[str], str | None]:
        page = await records.page(
            self._tables, records.MEMBERS, account, first="agent:", last="agent;", limit=limit, cursor=cursor
        )
        return [row.key.removeprefix("agent:") for row in page.rows], page.cursor

    async def _shared_agent_ids(self, account: str) -> list[str]:
        """Agents that may have shared devices. The shares themselves decide."""
        result: set[str] = set()
        async for row in records.all_rows(self._tables, records.MEMBERS, account, first="share:", last="share;"):
            kind, name = access.split_target(row.key.removeprefix("share:"))
            if kind == "space":
                result |= set(await self._all_agent_ids(str(row.data["owner"])))
            elif (parts := split_device(name)) is not None:
                result.add(parts[0])
        return sorted(result)

    async def _all_agent_ids(self, account: str) -> list[str]:
        rows = records.all_rows(self._tables, records.MEMBERS, account, first="agent:", last="agent;")
        return [row.key.removeprefix("agent:") async for row in rows]

    async def get_as_owner(self, device: str) -> Device | None:
        """A device with the permissions of its owner."""
        parts = split_device(device)
        row = await self._tables.get(records.AGENTS, parts[0], "agent") if parts else None
        if row is None:
            return None
        return next((result for result in devices_of(records.read(row, Agent)) if result.id == device), None)

    async def in_space(self, account: str, space: str) -> list[Device]:
        """The devices of an account's space, with the permissions of the owner."""
        ids = await self._all_agent_ids(account)
        rows = await asyncio.gather(*(self._tables.get(records.AGENTS, agent, "agent") for agent in ids))
        agents = [records.read(row, Agent) for row in rows if row is not None]
        return [
            device
            for agent in agents
            if agent.account == account and agent.space == space
            for device in devices_of(agent)
        ]

    async def _permissions(
        self, caller: Identity, agent: Agent, names: Iterable[str] | None = None
    ) -> dict[str, Permissions]:
        """Permissions of ``caller`` on the visible devices of an agent."""
        requested = [spec.name for spec in agent.devices] if names is None else list(names)
        shares: list[Share] = []
        if agent.account is not None and agent.account != caller.account:
            targets = [
                space_target(agent.space or ""),
                *(device_target(device_id(agent.id, name)) for name in requested),
            ]
            key = share_key(caller.account)
            rows = await asyncio.gather(*(self._tables.get(records.SHARES, on, key) for on in targets))
            shares = [records.read(row, Share) for row in rows if row is not None]
        now_ms = self._clock.now_ms()
        result = {name: access.permissions(caller, agent, name, shares, now_ms) for name in requested}
        return {name: allowed for name, allowed in result.items() if allowed is not None}

    async def _owner_name(self, caller: Identity, agent: Agent) -> str:
        if agent.account == caller.account and not caller.key:
            return caller.name
        row = await self._tables.get(records.ACCOUNTS, agent.account or "-", "account")
        return records.read(row, Account).name if row else ""

    async def of_agent(self, caller: Identity, agent_id: str, only: str | None = None) -> list[DeviceView]:
        """The visible devices of one agent, or the one called ``only``."""
        page = await self._tables.query(records.AGENTS, agent_id, limit=1000)
        rows = {row.key: row for row in page.rows}
        if "agent" not in rows:
            return []
        agent = records.read(rows["agent"], Agent)
        specs = [spec for spec in agent.devices if only in {None, spec.name}]
        allowed = await self._permissions(caller, agent, [spec.name for spec in specs])
        if not allowed:
            return []
        owner_name = await self._owner_name(caller, agent)
        now_ms = self._clock.now_ms()
        link = _of(agent, rows, "link", Link)
        views = []
        for spec in specs:
            if spec.name not in allowed:
                continue
            device = _device(agent, spec, allowed[spec.name])
            last = _of(agent, rows, f"state:{spec.name}", LastState)
            last_seen_ms = max(link.seen_ms if link else 0, last.seen_ms if last else 0)
            lease = await read_lease(self._tables, device)
            views.append(
                DeviceView(
                    device=device,
                    owner_name=owner_name,
                    online=devices.online(link, last_seen_ms, now_ms),
                    last_seen_ms=last_seen_ms or None,
                    state=last.state if last else None,
                    lease=lease if lease and lease.is_live(now_ms) and not _ended(lease, last) else None,
                    incompatible=incompatible(link),
                )
            )
        return views


def require_operator(device: Device) -> Device:
    """The device, if its role may operate. Raises ``forbidden``."""
    if not device.role.may_operate:
        raise forbidden("You may watch this device, but not operate it. Ask its owner.")
    return device


def require_owner(device: Device) -> Device:
    """The device, if its role is owner. Raises ``forbidden``."""
    if not device.role.may_own:
        raise forbidden("Only the owner of this device may do that. Request control at lease/requests.")
    return device


def require_claimed(agent: Agent) -> str:
    """The space of an agent, if it is claimed. Raises ``agent-unclaimed``."""
    if agent.space is None:
        detail = "This agent is not claimed yet. Wait until GET /agents/enrollment reports it."
        raise Problem("agent-unclaimed", 409, "The agent is not claimed", detail)
    return agent.space


def incompatible(link: Link | None) -> str:
    """Why the agent and this server cannot work together; empty if they can."""
    if link is None or link.protocol == (PROTOCOL.min, PROTOCOL.max):
        return ""
    lowest, highest = link.protocol
    return incompatibility(agent=VersionRange(min=lowest, max=highest), server=PROTOCOL)


def require_online(link: Link | None, now_ms: int) -> None:
    """Reject commands to a device whose agent is offline (``device-offline``) or too old or new.

    Raises:
        Problem: ``device-offline``: the agent reported "offline" or stopped polling; ``protocol-unsupported``.
    """
    if problem := incompatible(link):
        raise protocol_unsupported(problem)
    if link is not None and not (devices.online(link, link.seen_ms, now_ms) if link.polled else link.online):
        detail = "The device's agent is offline. Check that it is running and connected."
        raise Problem("device-offline", 409, "The device is offline", detail)


def share_key(account: str) -> str:
    """Row key of an account's share."""
    return f"account:{account}"


def devices_of(agent: Agent) -> list[Device]:
    """The devices of a claimed agent, with the permissions of the owner."""
    return [_device(agent, spec) for spec in agent.devices]


def departed_devices(agent: Agent, leaving: Departure) -> list[Device]:
    """The devices of a departure, with the permissions of their former owner."""
    before = replace(agent, account=leaving.account, space=leaving.space, pairing=leaving.pairing)
    unknown = DeviceSpec("", "", "", "")
    return [_device(before, replace(agent.device(name) or unknown, name=name)) for name in leaving.devices]


def _ended(lease: Lease, last: LastState | None) -> bool:
    """Whether the device has ended this lease."""
    return last is not None and last.ended_epoch >= lease.epoch


def _of(agent: Agent, rows: dict[str, Row], key: str, kind: type[T]) -> T | None:
    """The record in a row, if it belongs to the current pairing."""
    if key not in rows or rows[key].data.get("pairing", "") not in {"", agent.pairing}:
        return None
    return records.read(rows[key], kind)


def _device(agent: Agent, spec: DeviceSpec, allowed: Permissions = OWNER_PERMISSIONS) -> Device:
    space = agent.space or ""
    return Device(
        id=device_id(agent.id, spec.name),
        name=spec.name,
        label=agent.labels.get(spec.name, spec.label),
        kind=spec.kind,
        robot_type=spec.robot_type,
        agent=agent.id,
        space=space,
        pairing=agent.pairing,
        role=allowed.role,
        topic=f"{topics.ROOT}/{space}/{agent.id}/{spec.name}",
        transport=agent.transport,
        owner=agent.account or "",
        until_ms=allowed.until_ms,
        space_role=allowed.space,
        agent_key=agent.public_key,
    )
