"""Long polling of commands; each poll marks the agent as online."""

import asyncio
import contextlib
from collections.abc import Collection

from function_app.domain.devices.devices import Agent, Link, polled
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.devices.device_access import require_claimed
from function_app.services.messaging.mailbox import Mailbox, MailboxEntry
from function_app.services.storage import records

_POLL_S = 0.05
_SLOWEST_POLL_S = 0.25
"""Commands stored by another instance are only found by reading."""


class CommandPolling:
    """Plain and long polling."""

    def __init__(self, *, tables: Tables, mailbox: Mailbox, clock: Clock) -> None:
        self._tables = tables
        self._mailbox = mailbox
        self._clock = clock

    async def commands(self, agent: Agent, *, wait_ms: int, limit: int, have: Collection[str]) -> list[MailboxEntry]:
        """Commands for the agent, as soon as there is one; none after ``wait_ms``.

        Raises:
            Problem: ``agent-unclaimed``, ``busy``.
        """
        require_claimed(agent)
        await self.mark_online(agent)
        loop = asyncio.get_running_loop()
        end = loop.time() + wait_ms / 1000
        pause_s = _POLL_S
        with self._mailbox.changes(agent.id) as changed:
            while True:
                changed.clear()
                result = await self._mailbox.pending(agent, limit=limit, have=have)
                left_s = end - loop.time()
                if result or left_s <= 0:
                    return result
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(min(pause_s, left_s)):
                        await changed.wait()
                pause_s = min(2 * pause_s, _SLOWEST_POLL_S)

    async def mark_online(self, agent: Agent) -> None:
        """Mark the agent as online, written at intervals. MQTT agents report their connection themselves.

        Raises:
            Problem: ``busy``.
        """
        if agent.transport == "mqtt":
            return
        now_ms = self._clock.now_ms()
        await records.upsert(
            self._tables,
            records.AGENTS,
            agent.id,
            "link",
            lambda existing: polled(existing, now_ms, agent.pairing),
            Link,
        )
