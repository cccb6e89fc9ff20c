"""Commands for polling agents, and acks that a sender waits for.

At-least-once: a command is returned by every poll until it is acknowledged or expires. The agent drops duplicates by
id. ``Retention`` deletes the rows of agents that do not poll.
"""

import asyncio
import contextlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

from device_agent.protocol import Ack, AckStatus, Reason
from function_app.domain.common.ids import oldest_first, split_command
from function_app.domain.devices.devices import Agent, Device
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records
from function_app.services.storage.retention import Retention

PAGE = 100
RESPONSE_BYTES = 1_000_000
"""Maximum size of a response [bytes], unless it has a single payload."""
_FIRST, _OTHERS, _BEHIND = "0", "1", "2"
_DELETE_INTERVAL_MS = 3_600_000
"""Deletions are scheduled at most once per hour and agent."""


@dataclass(frozen=True, slots=True)
class MailboxEntry:
    """A command as it would be published with MQTT. The row stores the payload in base64."""

    command: str
    topic: str
    payload: bytes
    expires_ms: int
    pairing: str


@dataclass(frozen=True, slots=True)
class AwaitedAck:
    """The first decisive ack of a command whose sender waits."""

    expires_ms: int
    status: AckStatus | None = None
    reason: Reason | None = None


class Answer(NamedTuple):
    """A decisive ack. ``reason``: why the device rejected or ended the command."""

    status: AckStatus
    reason: Reason | None = None

    @classmethod
    def of(cls, ack: Ack) -> Self:
        """The answer in an ack."""
        return cls(ack.status, ack.reason)


class Mailbox:
    """Stores commands, and notifies waiting polls in this process. Other processes poll the rows."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock
        self._scheduled: dict[str, int] = {}
        self._waiting: dict[str, set[asyncio.Event]] = {}

    async def put(
        self, device: Device, command: str, *, topic: str, payload: bytes, expires_ms: int, first: bool
    ) -> None:
        """Store a command for the device's agent until ``expires_ms`` [ms since 1970], in place of one with this id.

        A stored command is not replaced by one that expires earlier.

        ``first``: returned before all others, as a Stop.
        """
        entry = MailboxEntry(command, topic, payload, expires_ms, device.pairing)
        await self._schedule_deletion(device.agent, expires_ms)
        key = _key(command, first=first)
        try:
            await self._tables.create(records.MAILBOX, Row(device.agent, key, records.to_data(entry)))
        except Conflict:
            # A command that was rejected because of its epoch is issued again with another payload.
            await records.upsert(
                self._tables,
                records.MAILBOX,
                device.agent,
                key,
                lambda existing: (
                    None if existing is not None and (existing.expires_ms > expires_ms or existing == entry) else entry
                ),
                MailboxEntry,
            )
        self._notify(device.agent)

    async def pending(self, agent: Agent, *, limit: int, have: Collection[str] = ()) -> list[MailboxEntry]:
        """Unacknowledged commands of this pairing, Stop first, then oldest first; without the ids in ``have``."""
        result: list[MailboxEntry] = []
        now_ms, size = self._clock.now_ms(), 0
        cursor: str | None = None
        while True:
            page = await self._tables.query(
                records.MAILBOX, agent.id, first=_FIRST, last=_BEHIND, limit=PAGE, cursor=cursor
            )
            for row in page.rows:
                entry = records.read(row, MailboxEntry)
                if entry.pairing != agent.pairing or entry.expires_ms <= now_ms or entry.command in have:
                    continue
                size += len(entry.payload)
                if result and size > RESPONSE_BYTES:
                    return result
                result.append(entry)
                if len(result) == limit:
                    return result
            cursor = page.cursor
            if cursor is None:
                return result

    async def withdraw(self, agent: str, command: str) -> None:
        """Delete a command that was acknowledged or is obsolete."""
        for first in (False, True):
            row = await self._tables.get(records.MAILBOX, agent, _key(command, first=first))
            if row is not None:
                await records.discard(self._tables, records.MAILBOX, row)
                return

    async def expect_ack(self, device: Device, command: str, *, expires_ms: int) -> None:
        """Create the row for the ack of a command, before the command is sent. Acks without this row are not stored."""
        await self._schedule_deletion(device.agent, expires_ms)
        awaited_row = Row(device.agent, _ack_key(command), records.to_data(AwaitedAck(expires_ms)))
        with contextlib.suppress(Conflict):
            await self._tables.create(records.MAILBOX, awaited_row)

    async def store_ack(self, agent: str, ack: Ack) -> None:
        """Store an ack, if its row exists and has no later ack.

        Raises:
            Problem: ``busy``.
        """

        async def attempt() -> None:
            row = await self._tables.get(records.MAILBOX, agent, _ack_key(ack.id))
            if row is None:
                return
            awaited = records.read(row, AwaitedAck)
            if awaited.status is None or (ack.status.terminal and not awaited.status.terminal):
                status, reason = Answer.of(ack)
                data = records.to_data(replace(awaited, status=status, reason=reason))
                await self._tables.replace(records.MAILBOX, row.changed(data))

        await records.retry(attempt)
        self._notify(agent)

    async def stored_ack(self, agent: str, command: str) -> Answer | None:
        """The stored ack of a command."""
        _, awaited = await records.find(self._tables, records.MAILBOX, agent, _ack_key(command), AwaitedAck)
        return None if awaited is None or awaited.status is None else Answer(awaited.status, awaited.reason)

    @contextlib.contextmanager
    def changes(self, agent: str) -> Iterator[asyncio.Event]:
        """An event that is set when this process changes the agent's mailbox."""
        changed = asyncio.Event()
        waiting = self._waiting.setdefault(agent, set())
        waiting.add(changed)
        try:
            yield changed
        finally:
            waiting.discard(changed)
            if not waiting:
                self._waiting.pop(agent, None)

    def _notify(self, agent: str) -> None:
        for changed in self._waiting.get(agent, ()):
            changed.set()

    async def _schedule_deletion(self, agent: str, expires_ms: int) -> None:
        due_ms = -(-expires_ms // _DELETE_INTERVAL_MS) * _DELETE_INTERVAL_MS
        if self._scheduled.get(agent, 0) >= due_ms:
            return
        await self._retention.delete_rows_at(records.MAILBOX, agent, first="", last=None, due_ms=due_ms)
        if len(self._scheduled) > PAGE * PAGE:
            self._scheduled.clear()
        self._scheduled[agent] = due_ms


def _key(command: str, *, first: bool) -> str:
    parts = split_command(command)
    order = oldest_first(parts[1]) if parts else ""
    return f"{_FIRST if first else _OTHERS}:{order}:{command}"


def _ack_key(command: str) -> str:
    return f"ack:{command}"
