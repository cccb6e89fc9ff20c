"""Stored commands of one agent, acks that a sender waits for, and their deletion."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import Ack, AckStatus, Reason
from function_app.domain.common.ids import command_id
from function_app.services.messaging import mailbox as module
from function_app.services.messaging.mailbox import Answer, MailboxEntry
from function_app.services.storage import records
from tests.unit.function_app.services.messaging.conftest import AGENT, ARM, PolledMailbox

Put = Callable[..., list[MailboxEntry]]
HOUR_MS = 3_600_000


@pytest.fixture
def put(polled_mailbox: PolledMailbox) -> Put:
    """Stores a command that expires in a minute; returns the pending ones."""
    end_ms = polled_mailbox.clock.now_ms() + 60_000

    def put_one(command: str, payload: bytes, *, after_ms: int = 0, first: bool = False) -> list[MailboxEntry]:
        call = polled_mailbox.put(ARM, command, topic="t", payload=payload, expires_ms=end_ms + after_ms, first=first)
        polled_mailbox.loop.complete(call)
        return pending(polled_mailbox)

    return put_one


def pending(mailbox: PolledMailbox, **options: Any) -> list[MailboxEntry]:
    return mailbox.loop.complete(mailbox.pending(AGENT, **{"limit": 9, **options}))


def keys(mailbox: PolledMailbox, table: str = records.MAILBOX) -> list[str]:
    return [row.key for _, row in mailbox.tables.rows(table)]


def test_a_command_is_replaced_unless_the_new_one_expires_earlier(put: Put) -> None:
    for payload, after_ms, stored in (
        (b"first", 0, b"first"),
        (b"earlier", -1, b"first"),
        (b"again", 0, b"again"),
        (b"later", 1, b"later"),
    ):
        (entry,) = put("c1", payload, after_ms=after_ms)
        assert (entry.command, entry.topic, entry.payload) == ("c1", "t", stored)


def test_an_equal_command_is_not_written_again(put: Put, polled_mailbox: PolledMailbox) -> None:
    put("c1", b"x")
    rows = polled_mailbox.tables.rows(records.MAILBOX)
    put("c1", b"x")
    assert polled_mailbox.tables.rows(records.MAILBOX) == rows


def test_a_page_is_full_at_its_size_and_has_at_least_one_command(put: Put, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RESPONSE_BYTES", 100)
    for command, size, page in (
        ("c1", 95, ["c1"]),
        ("c2", 5, ["c1", "c2"]),
        ("c3", 1, ["c1", "c2"]),
        ("c0", 101, ["c0"]),
    ):
        assert [entry.command for entry in put(command, b"x" * size)] == page


def test_a_stop_comes_first_and_the_others_in_their_order(put: Put, polled_mailbox: PolledMailbox) -> None:
    now_ms = polled_mailbox.clock.now_ms()
    newer, older = (command_id(ARM.id, time_ms) for time_ms in (now_ms, now_ms - 1000))
    put(newer, b"x")
    put(older, b"x")
    assert [entry.command for entry in put("c2", b"x", first=True)] == ["c2", older, newer]


def test_commands_of_many_pages_are_read_up_to_the_limit(
    put: Put, polled_mailbox: PolledMailbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PAGE", 2)
    for number in range(5):
        put(f"c{number}", b"x")
    for options, expected in (({}, "01234"), ({"limit": 3}, "012"), ({"have": {"c0", "c3"}, "limit": 2}, "12")):
        assert [entry.command for entry in pending(polled_mailbox, **options)] == [f"c{each}" for each in expected]


def test_commands_of_other_pairings_and_expired_ones_are_not_pending(put: Put, polled_mailbox: PolledMailbox) -> None:
    put("c1", b"x", after_ms=1)
    put("c2", b"x")
    other = replace(AGENT, pairing="other")
    assert polled_mailbox.loop.complete(polled_mailbox.pending(other, limit=9)) == []
    polled_mailbox.clock.advance(60)
    assert [entry.command for entry in pending(polled_mailbox)] == ["c1"]


def test_a_withdrawn_command_or_stop_is_deleted(put: Put, polled_mailbox: PolledMailbox) -> None:
    for first in (False, True):
        put("c1", b"x", first=first)
        put("c2", b"x", first=first)
        polled_mailbox.loop.complete(polled_mailbox.withdraw(AGENT.id, "c1"))
        assert [entry.command for entry in pending(polled_mailbox)] == ["c2"]
        polled_mailbox.loop.complete(polled_mailbox.withdraw(AGENT.id, "c2"))


def stale(epoch: int) -> Reason:
    return Reason(code="stale_epoch", message="", epoch=epoch)


def ack(status: AckStatus, *, epoch: int = 0) -> Ack:
    reason = stale(epoch) if epoch else None
    return Ack(id="c1", status=status, sequence=1, at_ms=1, tick_ms=1, reason=reason)


@pytest.mark.parametrize(
    ("acks", "answer"),
    [
        ([], None),
        ([ack(AckStatus.STARTED)], Answer(AckStatus.STARTED)),
        ([ack(AckStatus.ACCEPTED), ack(AckStatus.STARTED)], Answer(AckStatus.ACCEPTED)),
        ([ack(AckStatus.STARTED), ack(AckStatus.FAILED, epoch=7)], Answer(AckStatus.FAILED, stale(7))),
        ([ack(AckStatus.FAILED, epoch=7), ack(AckStatus.DONE)], Answer(AckStatus.FAILED, stale(7))),
    ],
)
def test_the_first_ack_is_stored_until_a_terminal_one_follows(
    polled_mailbox: PolledMailbox, acks: list[Ack], answer: Answer | None
) -> None:
    complete = polled_mailbox.loop.complete
    for each in acks:
        complete(polled_mailbox.store_ack(AGENT.id, each))
    assert complete(polled_mailbox.stored_ack(AGENT.id, "c1")) is None, "no sender waits"
    complete(polled_mailbox.expect_ack(ARM, "c1", expires_ms=HOUR_MS))
    for each in acks:
        complete(polled_mailbox.store_ack(AGENT.id, each))
    complete(polled_mailbox.expect_ack(ARM, "c1", expires_ms=HOUR_MS))
    assert complete(polled_mailbox.stored_ack(AGENT.id, "c1")) == answer
    assert complete(polled_mailbox.stored_ack(AGENT.id, "c2")) is None


def test_a_caller_is_notified_of_changes_of_its_agent_only(put: Put, polled_mailbox: PolledMailbox) -> None:
    with polled_mailbox.changes(AGENT.id) as own, polled_mailbox.changes("b") as other:
        with polled_mailbox.changes(AGENT.id) as ended:
            pass
        for change in (
            lambda: put("c1", b"x"),
            lambda: polled_mailbox.loop.complete(polled_mailbox.store_ack(AGENT.id, ack(AckStatus.DONE))),
        ):
            own.clear()
            change()
            assert [event.is_set() for event in (own, other, ended)] == [True, False, False]
    assert polled_mailbox._waiting == {}


@pytest.mark.parametrize(("expires_ms", "due_ms"), [(10 * HOUR_MS, 10 * HOUR_MS), (10 * HOUR_MS + 1, 11 * HOUR_MS)])
@pytest.mark.parametrize("kind", ["command", "ack"])
def test_rows_are_deleted_in_the_hour_after_their_end(
    polled_mailbox: PolledMailbox, kind: str, expires_ms: int, due_ms: int
) -> None:
    complete = polled_mailbox.loop.complete
    if kind == "ack":
        complete(polled_mailbox.expect_ack(ARM, "c1", expires_ms=expires_ms))
    else:
        complete(polled_mailbox.put(ARM, "c1", topic="t", payload=b"", expires_ms=expires_ms, first=True))
    complete(polled_mailbox.retention.delete_due(due_ms - 1))
    assert len(keys(polled_mailbox)) == 1
    complete(polled_mailbox.retention.delete_due(due_ms))
    assert keys(polled_mailbox) == []


def test_one_deletion_is_scheduled_per_agent_and_hour(polled_mailbox: PolledMailbox) -> None:
    for command, expires_ms, scheduled in (("c1", HOUR_MS, 1), ("c2", HOUR_MS - 1, 1), ("c3", HOUR_MS + 1, 2)):
        polled_mailbox.loop.complete(polled_mailbox.expect_ack(ARM, command, expires_ms=expires_ms))
        assert len(keys(polled_mailbox, records.FORGET)) == scheduled
    polled_mailbox.tables.drop(records.FORGET)
    polled_mailbox.loop.complete(polled_mailbox.expect_ack(ARM, "c4", expires_ms=HOUR_MS + 1))
    assert keys(polled_mailbox, records.FORGET) == [], "it is scheduled already"


def test_the_memory_of_scheduled_deletions_is_bounded(
    polled_mailbox: PolledMailbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PAGE", 2)
    sizes = []
    for number in range(6):
        device = replace(ARM, agent=f"agent{number}")
        polled_mailbox.loop.complete(polled_mailbox.expect_ack(device, "c1", expires_ms=1))
        sizes.append(len(polled_mailbox._scheduled))
    assert sizes == [1, 2, 3, 4, 5, 1]
