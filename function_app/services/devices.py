"""Devices as an account may see them."""

import asyncio
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from device_agent.protocol import topics
from function_app.domain import devices
from function_app.domain.accounts import Identity, Role
from function_app.domain.devices import Agent, Device, DeviceSpec, LastState, Leaving, Link
from function_app.domain.ids import device_id, split_device
from function_app.domain.lease import Lease
from function_app.domain.problems import Problem, forbidden, invalid, not_found
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, Tables
from function_app.services import store
from function_app.services.control import read_lease

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class DeviceView:
    """A device with what is known of it now."""

    device: Device
    online: bool
    last_seen_ms: int | None
    state: dict[str, Any] | None
    lease: Lease | None


class Devices:
    """Looks devices up. What does not belong to the account does not exist for it."""

    def __init__(self, *, tables: Tables, clock: Clock) -> None:
        self._tables = tables
        self._clock = clock

    async def get(self, who: Identity, device: str) -> Device:
        """One device.

        Raises:
            Problem: ``device-unknown``.
        """
        found, _ = await self.with_link(who, device)
        return found

    async def with_link(self, who: Identity, device: str) -> tuple[Device, Link | None]:
        """One device and the last word about its agent's connection, in one read.

        Raises:
            Problem: ``device-unknown``.
        """
        found, link = await self.find(who, device)
        if found is None:
            raise not_found("device", device)
        return found, link

    async def find(self, who: Identity, device: str) -> tuple[Device | None, Link | None]:
        """As ``with_link``, with ``None`` for a device that does not exist for ``who``."""
        parts = split_device(device)
        if parts is None:
            return None, None
        page = await self._tables.query(store.AGENTS, parts[0], first="agent", last="link ", limit=2)
        rows = {row.key: row for row in page.rows}
        agent = _agent(rows, who)
        spec = agent.device(parts[1]) if agent else None
        if agent is None or spec is None:
            return None, None
        return _device(agent, spec), _of(agent, rows, "link", Link)

    async def view(self, who: Identity, device: str) -> DeviceView:
        """One device with what is known of it now.

        Raises:
            Problem: ``device-unknown``.
        """
        parts = split_device(device)
        if parts is not None:
            for view in await self.of_agent(who, parts[0], only=parts[1]):
                return view
        raise not_found("device", device)

    async def views(self, who: Identity, *, cursor: str | None, limit: int) -> tuple[list[DeviceView], str | None]:
        """All devices of the account, agent by agent: a page holds those of up to ``limit`` agents.

        Raises:
            Problem: ``cursor-invalid``.
        """
        ids, following = await self._agent_ids(who, cursor, limit)
        found = await asyncio.gather(*(self.of_agent(who, agent) for agent in ids))
        return [view for views in found for view in views], following

    async def all(self, who: Identity) -> list[Device]:
        """Every device of the account, without what is known of it now."""
        found: list[Device] = []
        cursor: str | None = None
        while True:
            agents, cursor = await self.agents(who, cursor=cursor, limit=1000)
            found += [_device(agent, spec) for agent in agents for spec in agent.devices]
            if cursor is None:
                return found

    async def agents(self, who: Identity, *, cursor: str | None, limit: int) -> tuple[list[Agent], str | None]:
        """The account's agents.

        Raises:
            Problem: ``cursor-invalid``.
        """
        ids, following = await self._agent_ids(who, cursor, limit)
        rows = await asyncio.gather(*(self._tables.get(store.AGENTS, agent, "agent") for agent in ids))
        agents = [store.read(row, Agent) for row in rows if row is not None]
        return [agent for agent in agents if agent.account == who.account], following

    async def _agent_ids(self, who: Identity, cursor: str | None, limit: int) -> tuple[list[str], str | None]:
        try:
            page = await self._tables.query(
                store.MEMBERS, who.account, first="agent:", last="agent;", limit=limit, cursor=cursor
            )
        except ValueError as error:
            raise invalid("The cursor is not one of this list. Begin without one.", code="cursor-invalid") from error
        return [row.key.removeprefix("agent:") for row in page.rows], page.cursor

    async def of_agent(self, who: Identity, agent_id: str, only: str | None = None) -> list[DeviceView]:
        """The devices of one agent, or the one called ``only``; none when the agent is not the account's."""
        page = await self._tables.query(store.AGENTS, agent_id, limit=1000)
        rows = {row.key: row for row in page.rows}
        agent = _agent(rows, who)
        if agent is None:
            return []
        now_ms = self._clock.now_ms()
        link = _of(agent, rows, "link", Link)
        views = []
        for spec in agent.devices:
            if only not in (None, spec.name):
                continue
            device = _device(agent, spec)
            last = _of(agent, rows, f"state:{spec.name}", LastState)
            seen_ms = max(link.seen_ms if link else 0, last.seen_ms if last else 0)
            lease = await read_lease(self._tables, device)
            views.append(
                DeviceView(
                    device=device,
                    online=devices.online(link, seen_ms, now_ms),
                    last_seen_ms=seen_ms or None,
                    state=last.state if last else None,
                    lease=lease if lease and lease.live(now_ms) and not _ended(lease, last) else None,
                )
            )
        return views


def require_operator(device: Device) -> Device:
    """The same device, once it is seen that its role may operate.

    Raises:
        Problem: ``forbidden``.
    """
    if not device.role.may_operate:
        raise forbidden("You may watch this device, not operate it. Ask its owner.")
    return device


def require_owner(device: Device) -> Device:
    """The same device, once it is seen that its role is the owner's.

    Raises:
        Problem: ``forbidden``.
    """
    if not device.role.may_own:
        raise forbidden("Only an owner of this device may take control over from somebody. Ask for it instead.")
    return device


def require_claimed(agent: Agent) -> str:
    """The space of an agent, once it is seen that somebody has claimed it.

    Raises:
        Problem: ``agent-unclaimed``.
    """
    if agent.space is None:
        detail = "Nobody has claimed this agent yet. Wait for GET /agents/enrollment to say so."
        raise Problem("agent-unclaimed", 409, "The agent is not claimed", detail)
    return agent.space


def require_online(link: Link | None, now_ms: int) -> None:
    """Refuse what cannot arrive.

    Raises:
        Problem: ``device-offline``: the agent's last word was "offline", or it polls and has stopped to.
    """
    if link is not None and not (devices.online(link, link.seen_ms, now_ms) if link.polled else link.online):
        detail = "The device's agent is offline. Check that it runs and has network."
        raise Problem("device-offline", 409, "The device is offline", detail)


def devices_of(agent: Agent) -> list[Device]:
    """The devices of a claimed agent, as its owner sees them."""
    return [_device(agent, spec) for spec in agent.devices]


def left_devices(agent: Agent, leaving: Leaving) -> list[Device]:
    """The devices that an agent has left behind, as their owner saw them."""
    before = replace(agent, account=leaving.account, space=leaving.space, pairing=leaving.pairing)
    gone = DeviceSpec("", "", "", "")
    return [_device(before, replace(agent.device(name) or gone, name=name)) for name in leaving.devices]


def _ended(lease: Lease, last: LastState | None) -> bool:
    """Whether the device has said that it will not obey this lease again."""
    return last is not None and last.ended_epoch >= lease.epoch


def _of(agent: Agent, rows: dict[str, Row], key: str, kind: type[T]) -> T | None:
    """What was said under the agent's present pairing."""
    if key not in rows or rows[key].data.get("pairing", "") not in {"", agent.pairing}:
        return None
    return store.read(rows[key], kind)


def _agent(rows: dict[str, Row], who: Identity) -> Agent | None:
    if "agent" not in rows:
        return None
    agent = store.read(rows["agent"], Agent)
    return agent if agent.account == who.account else None


def _device(agent: Agent, spec: DeviceSpec) -> Device:
    space = agent.space or ""
    return Device(
        id=device_id(agent.id, spec.name),
        name=spec.name,
        label=spec.label,
        kind=spec.kind,
        robot_type=spec.robot_type,
        agent=agent.id,
        space=space,
        pairing=agent.pairing,
        role=Role.OWNER,
        topic=f"{topics.ROOT}/{space}/{agent.id}/{spec.name}",
        transport=agent.transport,
    )
