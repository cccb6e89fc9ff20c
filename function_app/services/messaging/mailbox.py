"""Commands for polling agents, and acks that a sender waits for.

At-least-once: a command is returned by every poll until it is acknowledged or expires. The agent drops duplicates by
id. ``Retention`` deletes the rows of agents that do not poll.
"""

import asyncio
import contextlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from device_agent.protocol import Ack, AckStatus
from function_app.domain.common.ids import oldest_first, split_command
from function_app.domain.devices.devices import Agent, Device
from function_app.ports.clock import Clock
from function_app.ports.tables import Conflict, Row, Tables
from function_app.services.storage import records
from function_app.services.storage.retention import Retention

PAGE = 100
ANSWER_BYTES = 1_000_000
"""Maximum size of a response [bytes], unless it has a single payload."""
_FIRST, _OTHERS, _BEHIND = "0", "1", "2"
_TIDY_MS = 3_600_000
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
class Awaited:
    """The first decisive ack of a command whose sender waits."""

    expires_ms: int
    status: AckStatus | None = None


class Mailbox:
    """Stores commands, and notifies waiting polls in this process. Other processes poll the rows."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock
        self._noted: dict[str, int] = {}
        self._bells: dict[str, set[asyncio.Event]] = {}

    async def put(
        self, device: Device, command: str, *, topic: str, payload: bytes, expires_ms: int, first: bool
    ) -> None:
        """Store a command for the device's agent until ``expires_ms`` [ms since 1970]. Idempotent by command id.

        ``first``: returned before all others, as a Stop.
        """
        letter = MailboxEntry(command, topic, payload, expires_ms, device.pairing)
        await self._tidy_later(device.agent, expires_ms)
        with contextlib.suppress(Conflict):
            await self._tables.create(
                records.MAILBOX, Row(device.agent, _key(command, first=first), records.to_data(letter))
            )
        self._ring(device.agent)

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
                letter = records.read(row, MailboxEntry)
                if letter.pairing != agent.pairing or letter.expires_ms <= now_ms or letter.command in have:
                    continue
                size += len(letter.payload)
                if result and size > ANSWER_BYTES:
                    return result
                result.append(letter)
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

    async def expect_answer(self, device: Device, command: str, *, expires_ms: int) -> None:
        """Create the row for the ack of a command, before the command is sent. Acks without this row are not stored."""
        await self._tidy_later(device.agent, expires_ms)
        place = Row(device.agent, _answer_key(command), records.to_data(Awaited(expires_ms)))
        with contextlib.suppress(Conflict):
            await self._tables.create(records.MAILBOX, place)

    async def store_answer(self, agent: str, ack: Ack) -> None:
        """Store an ack, if its row exists and has no later ack.

        Raises:
            Problem: ``busy``.
        """

        async def attempt() -> None:
            row = await self._tables.get(records.MAILBOX, agent, _answer_key(ack.id))
            if row is None:
                return
            awaited = records.read(row, Awaited)
            if awaited.status is None or (ack.status.terminal and not awaited.status.terminal):
                data = records.to_data(replace(awaited, status=ack.status))
                await self._tables.replace(records.MAILBOX, replace(row, data=data))

        await records.retry(attempt)
        self._ring(agent)

    async def stored_answer(self, agent: str, command: str) -> AckStatus | None:
        """The stored ack of a command."""
        row = await self._tables.get(records.MAILBOX, agent, _answer_key(command))
        return None if row is None else records.read(row, Awaited).status

    @contextlib.contextmanager
    def listen(self, agent: str) -> Iterator[asyncio.Event]:
        """An event that is set when this process changes the agent's mailbox."""
        bell = asyncio.Event()
        bells = self._bells.setdefault(agent, set())
        bells.add(bell)
        try:
            yield bell
        finally:
            bells.discard(bell)
            if not bells:
                self._bells.pop(agent, None)

    def _ring(self, agent: str) -> None:
        for bell in self._bells.get(agent, ()):
            bell.set()

    async def _tidy_later(self, agent: str, expires_ms: int) -> None:
        due_ms = -(-expires_ms // _TIDY_MS) * _TIDY_MS
        if self._noted.get(agent, 0) >= due_ms:
            return
        await self._retention.delete_rows_at(records.MAILBOX, agent, first="", last=None, due_ms=due_ms)
        if len(self._noted) > PAGE * PAGE:
            self._noted.clear()
        self._noted[agent] = due_ms


def _key(command: str, *, first: bool) -> str:
    parts = split_command(command)
    order = oldest_first(parts[1]) if parts else ""
    return f"{_FIRST if first else _OTHERS}:{order}:{command}"


def _answer_key(command: str) -> str:
    return f"ack:{command}"
