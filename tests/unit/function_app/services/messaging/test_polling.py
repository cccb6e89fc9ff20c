"""Long polling in virtual time: when the tables are read, and when a poll ends."""

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Link
from function_app.services.messaging.polling import CommandPolling
from function_app.services.storage import records
from tests.unit.function_app.services.messaging.conftest import AGENT, ARM, PolledMailbox


@pytest.fixture
def polling(polled_mailbox: PolledMailbox) -> CommandPolling:
    return CommandPolling(tables=polled_mailbox.tables, mailbox=polled_mailbox, clock=polled_mailbox.clock)


def poll(polling: CommandPolling, mailbox: PolledMailbox, wait_ms: int, agent: Agent = AGENT) -> list[str]:
    entries = mailbox.loop.complete(polling.commands(agent, wait_ms=wait_ms, limit=2, have=("c0",)))
    return [entry.command for entry in entries]


async def put(mailbox: PolledMailbox, *commands: str, after_s: float = 0.0) -> None:
    await asyncio.sleep(after_s)
    expires_ms = mailbox.clock.now_ms() + 60_000
    for command in commands:
        await mailbox.put(ARM, command, topic="t", payload=b"{}", expires_ms=expires_ms, first=False)


@pytest.mark.parametrize(
    ("wait_ms", "read_s"), [(0, [0.0]), (1, [0.0, 0.001]), (1000, [0.0, 0.05, 0.15, 0.35, 0.4, 0.65, 0.9, 1.0])]
)
def test_the_tables_are_read_after_growing_pauses_and_at_once_after_a_change(
    polling: CommandPolling, polled_mailbox: PolledMailbox, wait_ms: int, read_s: list[float]
) -> None:
    polled_mailbox.change_at(0.4, AGENT.id)
    assert poll(polling, polled_mailbox, wait_ms) == []
    assert polled_mailbox.read_s == read_s


def test_a_poll_ends_with_the_first_commands_that_the_agent_does_not_have(
    polling: CommandPolling, polled_mailbox: PolledMailbox
) -> None:
    polled_mailbox.loop.complete(put(polled_mailbox, "c0"))
    task = polled_mailbox.loop.create_task(put(polled_mailbox, "c1", after_s=0.1))
    assert poll(polling, polled_mailbox, 1000) == ["c1"]
    assert polled_mailbox.read_s == [0.0, 0.05, 0.1]
    assert task.done()
    polled_mailbox.loop.complete(put(polled_mailbox, "c2", "c3"))
    assert poll(polling, polled_mailbox, 1000) == ["c1", "c2"]


def test_an_agent_without_owner_is_refused(polling: CommandPolling, polled_mailbox: PolledMailbox) -> None:
    unclaimed = Agent(id="a", name="lab", public_key="", software="", devices=(), created_ms=0)
    with pytest.raises(Problem) as problem:
        poll(polling, polled_mailbox, 0, unclaimed)
    assert problem.value.code == "agent-unclaimed"
    assert polled_mailbox.read_s == []


@pytest.mark.parametrize(("transport", "stored"), [("http", True), ("xmpp", True), ("mqtt", False)])
def test_a_poll_marks_the_agent_as_online_unless_it_uses_mqtt(
    polling: CommandPolling, polled_mailbox: PolledMailbox, transport: Any, stored: bool
) -> None:
    agent = replace(AGENT, transport=transport)
    poll(polling, polled_mailbox, 0, agent)
    _, link = polled_mailbox.loop.complete(records.find(polled_mailbox.tables, records.AGENTS, AGENT.id, "link", Link))
    expected = Link(online=True, session=0, seen_ms=polled_mailbox.clock.now_ms(), polled=True, pairing="p")
    assert link == (expected if stored else None)
