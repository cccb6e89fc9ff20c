"""Enrolment: an agent registers with its own key and waits until it is claimed."""

import asyncio
from dataclasses import dataclass, replace

from device_agent.protocol import PROTOCOL, VersionRange, incompatibility
from function_app.domain.common.ids import new_claim_code
from function_app.domain.common.problems import Problem, protocol_unsupported
from function_app.domain.devices.devices import Agent, DeviceSpec, Link, Transport, with_devices
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.pairing.offboarding import Offboarding
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention

CLAIM_MS = 300_000
KEEP_UNCLAIMED_MS = 7 * DAY_MS
"""An unclaimed agent requests a new code every few minutes; without a request for this time it is deleted."""
_POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Enrollment:
    """The agent's own description."""

    name: str
    public_key: str
    software: str
    devices: tuple[DeviceSpec, ...]
    transport: Transport = "mqtt"
    protocol: VersionRange = PROTOCOL
    capabilities: tuple[str, ...] = ()


class Enroll:
    """Enrolls agents."""

    def __init__(self, *, tables: Tables, offboarding: Offboarding, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._offboarding = offboarding
        self._retention = retention
        self._clock = clock

    async def enroll(self, agent: str, enrollment: Enrollment) -> Agent:
        """Create or update the agent's row, with a new claim code while it is unclaimed.

        Actions of removed devices end. The row of the code is written first; it has no effect without the agent's row.

        Raises:
            Problem: ``agent-id-taken``: another key has the same id (one in 2⁵⁰); ``protocol-unsupported``.
        """
        if problem := incompatibility(agent=enrollment.protocol, server=PROTOCOL):
            await self._mark_incompatible(agent, enrollment)
            raise protocol_unsupported(problem)

        async def attempt() -> Agent:
            row = await self._tables.get(records.AGENTS, agent, "agent")
            now_ms = self._clock.now_ms()
            if row is None:
                record = Agent(
                    agent, enrollment.name, enrollment.public_key, enrollment.software, enrollment.devices, now_ms
                )
            else:
                record = records.read(row, Agent)
                if record.public_key != enrollment.public_key:
                    detail = "Another agent's key has the same id. Create a new key."
                    raise Problem("agent-id-taken", 409, "The id is taken", detail)
                before = record.leaving
                record = replace(
                    with_devices(record, enrollment.devices), name=enrollment.name, software=enrollment.software
                )
                if record.leaving != before:
                    await self._offboarding.watch(agent)
            record = replace(record, transport=enrollment.transport)
            if not record.claimed:
                expires_ms = now_ms + CLAIM_MS
                code = await self._new_code(agent, expires_ms)
                delete_ms = now_ms + KEEP_UNCLAIMED_MS
                await self._retention.delete_row_at(
                    records.AGENTS, agent, "agent", due_ms=(delete_ms // DAY_MS + 1) * DAY_MS
                )
                record = replace(record, claim_code=code, claim_expires_ms=expires_ms, expires_ms=delete_ms)
            await self._tables.batch(records.AGENTS, [records.write(row, agent, "agent", records.to_data(record))])
            return record

        record = await records.retry(attempt)
        if record.claimed and record.leaving:
            await self._offboarding.finish(agent)
        return record

    async def _mark_incompatible(self, agent_id: str, enrollment: Enrollment) -> None:
        """Store for the owner that the agent is not connected, and which versions it supports."""
        _, agent = await records.find(self._tables, records.AGENTS, agent_id, "agent", Agent)
        if agent is None or not agent.claimed or agent.public_key != enrollment.public_key:
            return
        now_ms, pairing = self._clock.now_ms(), agent.pairing
        versions = (enrollment.protocol.min, enrollment.protocol.max)

        def mark(existing: Link | None) -> Link:
            link = existing or Link(online=False, session=0, seen_ms=now_ms)
            return replace(
                link,
                online=False,
                seen_ms=now_ms,
                pairing=pairing,
                protocol=versions,
                capabilities=enrollment.capabilities,
            )

        await records.upsert(self._tables, records.AGENTS, agent_id, "link", mark, Link)

    async def wait(self, agent: Agent, wait_ms: int) -> Agent:
        """The agent, as soon as it is claimed, or after the time limit."""
        loop = asyncio.get_running_loop()
        end = loop.time() + wait_ms / 1000
        while not agent.claimed:
            left_s = end - loop.time()
            if left_s <= 0:
                break
            await asyncio.sleep(min(_POLL_S, left_s))
            row = await self._tables.get(records.AGENTS, agent.id, "agent")
            if row is None:
                break
            agent = records.read(row, Agent)
        return agent

    async def _new_code(self, agent: str, expires_ms: int) -> str:
        """A code without a live row."""
        while True:
            code = new_claim_code()
            try:
                data = {"agent": agent, "expires_ms": expires_ms}
                await self._tables.create(records.CLAIMS, Row(code[0], code, data))
            except Conflict:
                continue
            return code
