"""Faults that devices report in their state, and devices of which nothing is heard any more.

For each agent that is online there is a note in ``Watched``, by the time at which a device of it may have been silent
for too long: the timer looks at it then, and notes the next such time. A row beside the notes names the newest of an
agent's notes, the only one that counts.
"""

import asyncio
import contextlib
import hashlib

import msgspec

from device_agent.protocol import State
from function_app.domain.devices.devices import SILENT_MS, Agent, Device, LastState, Link
from function_app.domain.health.faults import Report, Severity, Source
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.devices.device_access import devices_of
from function_app.services.health.faults import Faults
from function_app.services.storage import records

SHARDS = 4
_LOOKED_AT = 100
_DEVICE, _CLOUD = "device", "cloud"


class ReportedFaults:
    """Compares what an agent says with what it said last."""

    def __init__(self, *, tables: Tables, faults: Faults, clock: Clock) -> None:
        self._tables = tables
        self._faults = faults
        self._clock = clock

    async def on_connected(self, agent: Agent, session: int) -> None:
        """Its agent says that it is online; to be called before that is written down.

        Raises:
            Problem: ``busy``.
        """
        row = await self._tables.get(records.AGENTS, agent.id, "link")
        if row is not None and records.read(row, Link).session >= session:
            return
        await self._watch(agent.id, self._clock.now_ms())
        for device in devices_of(agent):
            await self._faults.settle(device, _CLOUD, [])

    async def on_state(self, agent: Agent, name: str, state: State) -> None:
        """A device says how it is; to be called before that is written down.

        Raises:
            Problem: ``busy``.
        """
        device = next(result for result in devices_of(agent) if result.name == name)
        row = await self._tables.get(records.AGENTS, agent.id, f"state:{name}")
        existing = None if row is None else records.read(row, LastState)
        if existing is not None and msgspec.convert(existing.state, State, strict=False) == state:
            return  # delivered again: no sign of life
        now_ms = self._clock.now_ms()
        if existing is None or now_ms - existing.seen_ms > SILENT_MS:
            await self._watch(agent.id, now_ms)
            await self._faults.settle(device, _CLOUD, [])
        if existing is None or state.faults or existing.state.get("faults"):
            await self._faults.settle(device, _DEVICE, [_reported(fault.code, fault.message) for fault in state.faults])

    async def check_silent(self, now_ms: int) -> None:
        """One round: look at the agents whose time has come. Safe to repeat and to be run by many at once.

        Raises:
            Problem: ``busy``.
            StoreError: The tables cannot be used.
        """
        await asyncio.gather(*(self._shard(str(shard), now_ms) for shard in range(SHARDS)))

    async def _shard(self, shard: str, now_ms: int) -> None:
        page = await self._tables.query(records.WATCHED, shard, last=f"{now_ms + 1:013d}", limit=_LOOKED_AT)
        for note in page.rows:
            agent = note.key.partition(":")[2]
            newest = await self._tables.get(records.WATCHED, shard, f"agent:{agent}")
            if newest is None or newest.data["note"] <= note.key:
                await self._look(agent, now_ms)
            try:
                await self._tables.delete(records.WATCHED, note)
            except Conflict:
                continue

    async def _look(self, agent_id: str, now_ms: int) -> None:
        """Which devices of an agent that is said to be online are silent; and when to look again."""
        page = await self._tables.query(records.AGENTS, agent_id, limit=1000)
        rows = {row.key: row for row in page.rows}
        agent = records.read(rows["agent"], Agent) if "agent" in rows else None
        link = records.read(rows["link"], Link) if "link" in rows else None
        if agent is None or not agent.claimed or link is None or not link.online:
            return
        heard = []
        for device in devices_of(agent):
            state = rows.get(f"state:{device.name}")
            seen_ms = max(link.seen_ms, records.read(state, LastState).seen_ms if state else 0)
            silent = now_ms - seen_ms > SILENT_MS
            await self._faults.settle(device, _CLOUD, [_silent(device)] if silent else [])
            if not silent:
                heard.append(seen_ms)
        if heard:
            await self._watch(agent_id, min(heard))

    async def _watch(self, agent: str, seen_ms: int) -> None:
        """Look at an agent when it may have been silent for too long: the note, then that it is the newest one."""
        shard = str(hashlib.sha256(agent.encode()).digest()[0] % SHARDS)
        key = f"{seen_ms + SILENT_MS + 1:013d}:{agent}"
        with contextlib.suppress(Conflict):
            await self._tables.create(records.WATCHED, Row(shard, key, {}))

        async def attempt() -> None:
            newest = await self._tables.get(records.WATCHED, shard, f"agent:{agent}")
            if newest is None:
                await self._tables.create(records.WATCHED, Row(shard, f"agent:{agent}", {"note": key}))
            elif newest.data["note"] < key:
                await self._tables.replace(records.WATCHED, Row(shard, newest.key, {"note": key}, newest.etag))

        await records.retry(attempt)


def _reported(code: str, message: str) -> Report:
    said = message or f"The device reports '{code}'. Look at the device."
    return Report(code=code, source=Source.DEVICE, kind="reported", severity=Severity.ERROR, message=said)


def _silent(device: Device) -> Report:
    message = (
        f"Nothing was heard of {device.label or device.name} for {SILENT_MS // 1000} s, though its agent did not say "
        "good-bye. Check the agent's power and network; once it is heard again this clears by itself."
    )
    return Report(code="silent", source=Source.CLOUD, kind="silent", severity=Severity.WARNING, message=message)
