"""Commands for agents that ask for them, each until it is answered or its time is over; and answers somebody waits for.

At least once: a command is given at every asking until an ack of it has come. The agent drops doubles by id. Rows are
also deleted by ``Retention``, where an agent never asks again.
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
"""Payloads in one answer hold at most this much, or are one."""
_FIRST, _OTHERS, _BEHIND = "0", "1", "2"
_TIDY_MS = 3_600_000
"""One note an hour for each agent is enough: ``Retention`` keeps what has not expired."""


@dataclass(frozen=True, slots=True)
class MailboxEntry:
    """One command on its way, exactly as it would travel over MQTT. In its row as base64: any payload fits."""

    command: str
    topic: str
    payload: bytes
    expires_ms: int
    pairing: str


@dataclass(frozen=True, slots=True)
class Awaited:
    """The first answer that decides, to a command whose sender waits for it."""

    expires_ms: int
    status: AckStatus | None = None


class Mailbox:
    """The rows, and a bell for whoever waits in this process; others see the rows a moment later."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock
        self._noted: dict[str, int] = {}
        self._bells: dict[str, set[asyncio.Event]] = {}

    async def put(
        self, device: Device, command: str, *, topic: str, payload: bytes, expires_ms: int, first: bool
    ) -> None:
        """Keep a command for the device's agent. The same command twice is one.

        Args:
            device: Whom it is for.
            command: Its id.
            topic: The topic it would be published on.
            payload: JSON.
            expires_ms: From then on it is no longer given [ms since 1970].
            first: Before all others that wait: a Stop.
        """
        letter = MailboxEntry(command, topic, payload, expires_ms, device.pairing)
        await self._tidy_later(device.agent, expires_ms)
        with contextlib.suppress(Conflict):
            await self._tables.create(
                records.MAILBOX, Row(device.agent, _key(command, first=first), records.to_data(letter))
            )
        self._ring(device.agent)

    async def pending(self, agent: Agent, *, limit: int, have: Collection[str] = ()) -> list[MailboxEntry]:
        """Commands that nobody has answered, Stop first, then the oldest first.

        Args:
            agent: Whose; commands of an earlier pairing are not given.
            limit: At most so many.
            have: Ids of commands that are not to be given again.
        """
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
        """Do not give this command any more: it was answered, or nobody wants it now."""
        for first in (False, True):
            row = await self._tables.get(records.MAILBOX, agent, _key(command, first=first))
            if row is not None:
                with contextlib.suppress(Conflict):
                    await self._tables.delete(records.MAILBOX, row)
                return

    async def expect_answer(self, device: Device, command: str, *, expires_ms: int) -> None:
        """Make a place for the answer to a command. Before it is sent: an answer without a place is not kept."""
        await self._tidy_later(device.agent, expires_ms)
        place = Row(device.agent, _answer_key(command), records.to_data(Awaited(expires_ms)))
        with contextlib.suppress(Conflict):
            await self._tables.create(records.MAILBOX, place)

    async def store_answer(self, agent: str, ack: Ack) -> None:
        """Note an answer, where a place was made for it and nothing more final stands there.

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
        """What was noted in the place for the answer."""
        row = await self._tables.get(records.MAILBOX, agent, _answer_key(command))
        return None if row is None else records.read(row, Awaited).status

    @contextlib.contextmanager
    def listen(self, agent: str) -> Iterator[asyncio.Event]:
        """A bell that rings when this process has changed something in the agent's mailbox."""
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
