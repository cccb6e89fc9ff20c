"""An agent that polls, and a mailbox in virtual time that records when it is read."""

import asyncio
from collections.abc import Collection, Iterator

import pytest

from function_app.domain.devices.devices import Agent, Device, DeviceSpec
from function_app.domain.identity.accounts import Role
from function_app.services.messaging.mailbox import Answer, Mailbox, MailboxEntry
from function_app.services.storage.retention import Retention
from tests.fakes.blobs import MemoryBlobs
from tests.fakes.clock import MemoryClock
from tests.fakes.event_loop import VirtualTimeLoop
from tests.fakes.tables import MemoryTables

AGENT = Agent(
    id="aaaaaaaaaa", name="lab", public_key="", software="", devices=(DeviceSpec("arm", "arm", "ur5", "Arm"),),
    created_ms=0, account="owner", space="s", pairing="p", transport="http",
)  # fmt: skip
ARM = Device(
    id="aaaaaaaaaa-arm", name="arm", label="Arm", kind="arm", robot_type="ur5", agent=AGENT.id, space="s",
    pairing="p", role=Role.OWNER, topic="ts/v1/s/aaaaaaaaaa/arm", transport="http",
)  # fmt: skip


class PolledMailbox(Mailbox):
    """A mailbox that fails if it is read without pauses.

    Attributes:
        read_s: Times of all reads on the loop's clock [s].
    """

    def __init__(self) -> None:
        self.clock, self.tables = MemoryClock(), MemoryTables()
        self.loop = VirtualTimeLoop(self.clock)
        self.read_s: list[float] = []
        self.retention = Retention(tables=self.tables, blobs=MemoryBlobs(now_s=lambda: self.clock.now_ms() / 1000))
        super().__init__(tables=self.tables, retention=self.retention, clock=self.clock)

    def change_at(self, time_s: float, agent: str) -> None:
        """Notify all callers that wait for this agent."""
        self.loop.call_later(time_s, self._notify, agent)

    async def stored_ack(self, agent: str, command: str) -> Answer | None:
        self._note_read()
        return await super().stored_ack(agent, command)

    async def pending(self, agent: Agent, *, limit: int, have: Collection[str] = ()) -> list[MailboxEntry]:
        self._note_read()
        return await super().pending(agent, limit=limit, have=have)

    def _note_read(self) -> None:
        assert len(self.read_s) < 20, "it is read without a pause"
        self.read_s.append(round(asyncio.get_running_loop().time(), 3))


@pytest.fixture
def polled_mailbox() -> Iterator[PolledMailbox]:
    mailbox = PolledMailbox()
    yield mailbox
    mailbox.loop.end()
