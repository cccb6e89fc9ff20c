"""Faults from device states, and faults for silent devices.

Each online agent has a reminder in ``Watched`` for the time at which a device may count as silent. The timer then
checks the agent and schedules the next check. A second row names the newest reminder, which is the only valid one.
"""

import asyncio
import contextlib
import hashlib

import msgspec

from device_agent.protocol import Fault, State
from function_app.domain.devices.devices import SILENT_MS, Agent, Device, LastState, Link
from function_app.domain.health.faults import Report, Severity, Source
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.devices.device_access import devices_of
from function_app.services.health.faults import Faults
from function_app.services.storage import records

SHARDS = 4
_MAX_CHECKED = 100
_DEVICE, _CLOUD = "device", "cloud"


class ReportedFaults:
    """Raises and clears faults from device states."""

    def __init__(self, *, tables: Tables, faults: Faults, clock: Clock) -> None:
        self._tables = tables
        self._faults = faults
        self._clock = clock

    async def on_connected(self, agent: Agent, session: int) -> None:
        """Called when an agent connects, before the link is stored. Raises ``busy``."""
        row = await self._tables.get(records.AGENTS, agent.id, "link")
        if row is not None and records.read(row, Link).session >= session:
            return
        await self._schedule_check(agent.id, self._clock.now_ms())
        for device in devices_of(agent):
            await self._faults.settle(device, _CLOUD, [])

    async def on_state(self, agent: Agent, name: str, state: State) -> None:
        """Called with a device state, before it is stored. Raises ``busy``."""
        device = next(result for result in devices_of(agent) if result.name == name)
        _, existing = await records.find(self._tables, records.AGENTS, agent.id, f"state:{name}", LastState)
        if existing is not None and msgspec.convert(existing.state, State, strict=False) == state:
            return  # redelivered: the device is not necessarily active
        now_ms = self._clock.now_ms()
        if existing is None or now_ms - existing.seen_ms > SILENT_MS:
            await self._schedule_check(agent.id, now_ms)
            await self._faults.settle(device, _CLOUD, [])
        if existing is None or state.faults or existing.state.get("faults"):
            await self._faults.settle(device, _DEVICE, [_reported(fault) for fault in state.faults])

    async def check_silent(self, now_ms: int) -> None:
        """Check the agents that are due. Idempotent and safe to run concurrently. Raises ``busy``."""
        await asyncio.gather(*(self._shard(str(shard), now_ms) for shard in range(SHARDS)))

    async def _shard(self, shard: str, now_ms: int) -> None:
        page = await self._tables.query(records.WATCHED, shard, last=f"{now_ms + 1:013d}", limit=_MAX_CHECKED)
        for note in page.rows:
            agent = note.key.partition(":")[2]
            newest = await self._tables.get(records.WATCHED, shard, f"agent:{agent}")
            if newest is None or newest.data["note"] <= note.key:
                await self._check_agent(agent, now_ms)
            try:
                await self._tables.delete(records.WATCHED, note)
            except Conflict:
                continue

    async def _check_agent(self, agent_id: str, now_ms: int) -> None:
        """Update the faults for silent devices of an online agent, and schedule the next check."""
        page = await self._tables.query(records.AGENTS, agent_id, limit=1000)
        rows = {row.key: row for row in page.rows}
        agent = records.read(rows["agent"], Agent) if "agent" in rows else None
        link = records.read(rows["link"], Link) if "link" in rows else None
        if agent is None or not agent.claimed or link is None or not link.online:
            return
        last_seen = []
        for device in devices_of(agent):
            state = rows.get(f"state:{device.name}")
            seen_ms = max(link.seen_ms, records.read(state, LastState).seen_ms if state else 0)
            silent = now_ms - seen_ms > SILENT_MS
            await self._faults.settle(device, _CLOUD, [_silent(device)] if silent else [])
            if not silent:
                last_seen.append(seen_ms)
        if last_seen:
            await self._schedule_check(agent_id, min(last_seen))

    async def _schedule_check(self, agent: str, seen_ms: int) -> None:
        """Schedule a check of an agent: write the reminder, then mark it as the newest."""
        shard = str(hashlib.sha256(agent.encode()).digest()[0] % SHARDS)
        key = f"{seen_ms + SILENT_MS + 1:013d}:{agent}"
        with contextlib.suppress(Conflict):
            await self._tables.create(records.WATCHED, Row(shard, key, {}))

        async def attempt() -> None:
            newest = await self._tables.get(records.WATCHED, shard, f"agent:{agent}")
            if newest is None:
                await self._tables.create(records.WATCHED, Row(shard, f"agent:{agent}", {"note": key}))
            elif newest.data["note"] < key:
                await self._tables.replace(records.WATCHED, newest.changed({"note": key}))

        await records.retry(attempt)


def _reported(fault: Fault) -> Report:
    return Report(
        code=fault.code,
        source=Source.DEVICE,
        kind="reported",
        severity=Severity.ERROR,
        message=fault.message or f"The device reports '{fault.code}'. Check the device.",
        occurrences=fault.count,
    )


def _silent(device: Device) -> Report:
    message = (
        f"No message from {device.label or device.name} for {SILENT_MS // 1000} s, although its agent is connected. "
        "Check the agent's power and network. The fault clears with the next message."
    )
    return Report(code="silent", source=Source.CLOUD, kind="silent", severity=Severity.WARNING, message=message)
