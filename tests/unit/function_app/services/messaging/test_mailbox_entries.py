"""Stored commands of one agent: replacement, and the size of a page."""

from collections.abc import Callable, Iterator

import pytest

from function_app.domain.devices.devices import Agent
from function_app.services.devices.device_access import devices_of
from function_app.services.messaging import mailbox as module
from function_app.services.messaging.mailbox import MailboxEntry
from function_app.services.storage import records
from tests.harness.cloud.cloud import Cloud
from tests.harness.cloud.polling import PollingRobot

Put = Callable[..., list[MailboxEntry]]


@pytest.fixture
def put(cloud: Cloud) -> Iterator[Put]:
    """Stores a command that expires in a minute; returns the pending ones."""
    mailbox = cloud.functions.mailbox
    end_ms = cloud.clock.now_ms() + 60_000
    with PollingRobot(cloud) as robot:
        robot.pair(cloud.sign_in("anna"))
        row = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
        assert row is not None
        agent = records.read(row, Agent)

        def put_one(command: str, payload: bytes, *, after_ms: int = 0, first: bool = False) -> list[MailboxEntry]:
            device, expires_ms = devices_of(agent)[0], end_ms + after_ms
            call = mailbox.put(device, command, topic="t", payload=payload, expires_ms=expires_ms, first=first)
            cloud.run(call)
            return cloud.run(mailbox.pending(agent, limit=9))

        yield put_one


def test_a_command_is_replaced_unless_the_new_one_expires_earlier(put: Put) -> None:
    for payload, after_ms, stored in (
        (b"first", 0, b"first"),
        (b"earlier", -1, b"first"),
        (b"again", 0, b"again"),
        (b"later", 1, b"later"),
    ):
        (entry,) = put("c1", payload, after_ms=after_ms)
        assert (entry.command, entry.topic, entry.payload) == ("c1", "t", stored)


def test_a_page_is_full_at_its_size_and_has_at_least_one_command(put: Put, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RESPONSE_BYTES", 100)
    for command, size, page in (
        ("c1", 95, ["c1"]),
        ("c2", 5, ["c1", "c2"]),
        ("c3", 1, ["c1", "c2"]),
        ("c0", 101, ["c0"]),
    ):
        assert [entry.command for entry in put(command, b"x" * size)] == page


def test_a_stop_comes_before_older_commands(put: Put) -> None:
    put("c1", b"x")
    assert [entry.command for entry in put("c2", b"x", first=True)] == ["c2", "c1"]
