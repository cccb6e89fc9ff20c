"""Commands and Stops by transport; waiting for an ack ends at its time limit, also during mailbox changes."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal, cast

import pytest

from device_agent.protocol import Ack, AckStatus, Reason, topics
from function_app.adapters.local.clock import SystemClock
from function_app.ports.monitoring import NoTracing
from function_app.services.messaging.delivery import Confirmation, Delivery, SignedCommand
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.storage import records
from function_app.services.storage.retention import Retention
from tests.fakes.blobs import MemoryBlobs
from tests.fakes.broker_ports import QueuedAcks
from tests.fakes.tables import MemoryTables
from tests.unit.function_app.services.messaging.conftest import ARM, PolledMailbox


class BusyMailbox(Mailbox):
    """A mailbox that changes after each read."""

    async def stored_ack(self, agent: str, command: str) -> None:
        asyncio.get_running_loop().call_soon(self._notify, agent)
        assert await super().stored_ack(agent, command) is None


async def confirmed(wait_ms: int) -> bool:
    tables, clock = MemoryTables(), SystemClock()
    retention = Retention(tables=tables, blobs=MemoryBlobs(now_s=time.time))
    mailbox = BusyMailbox(tables=tables, retention=retention, clock=clock)
    unused: Any = None  # the agent polls
    delivery = Delivery(bus=unused, mailbox=mailbox, relay=unused, tracing=NoTracing())
    signed = SignedCommand("aaaaaaaaaa-arm-00000000000000000000", b"{}", clock.now_ms() + 5_000)
    async with asyncio.timeout(20):
        return (await delivery.send_confirmed(ARM, signed, wait_ms=wait_ms)).confirmed


def test_a_wait_ends_at_its_limit_during_a_concurrent_change() -> None:
    assert asyncio.run(confirmed(0)) is False
    assert asyncio.run(confirmed(30)) is False


def test_the_tables_are_read_after_growing_pauses_and_at_once_after_a_change(polled_mailbox: PolledMailbox) -> None:
    unused: Any = None  # the agent polls
    delivery = Delivery(bus=unused, mailbox=polled_mailbox, relay=unused, tracing=NoTracing())
    expires_ms = polled_mailbox.clock.now_ms() + 5_000
    signed = SignedCommand("aaaaaaaaaa-arm-00000000000000000000", b"{}", expires_ms)
    polled_mailbox.change_at(0.55, ARM.agent)
    polled_mailbox.loop.complete(delivery.send_confirmed(ARM, signed, wait_ms=1000))
    assert polled_mailbox.read_s == [0.0, 0.02, 0.06, 0.14, 0.3, 0.5, 0.55, 0.75, 0.95]


class AckBus:
    """A bus that receives these acks and then no more; ``None``: it receives none."""

    def __init__(self, statuses: Sequence[AckStatus] | None) -> None:
        self.statuses = statuses

    async def publish(self, topic: str, payload: bytes) -> None:
        del topic, payload

    @contextlib.asynccontextmanager
    async def acks(self, topic: str, command: str) -> AsyncIterator[AsyncIterator[Ack] | None]:
        assert (topic, command) == (ARM.topic, SIGNED.command)
        received: asyncio.Queue[Ack] = asyncio.Queue()
        for status in self.statuses or ():
            received.put_nowait(ack(status))
        yield None if self.statuses is None else QueuedAcks(received)


STALE = Reason(code="stale_epoch", message="", epoch=7)


def ack(status: AckStatus) -> Ack:
    reason = STALE if status is AckStatus.FAILED else None
    return Ack(id=SIGNED.command, status=status, sequence=1, at_ms=1, tick_ms=1, reason=reason)


SIGNED = SignedCommand("aaaaaaaaaa-arm-00000000000000000000", b"{}", 2**45)
RECEIVED, STARTED, FAILED, EXPIRED = AckStatus.RECEIVED, AckStatus.STARTED, AckStatus.FAILED, AckStatus.EXPIRED


@pytest.mark.parametrize(
    ("transport", "on_bus", "in_tables", "answer", "ends_s"),
    [
        ("mqtt", [RECEIVED, STARTED], None, Confirmation(confirmed=True), 0.0),
        ("mqtt", [RECEIVED, FAILED], None, Confirmation(confirmed=False, reason=STALE), 0.0),
        ("mqtt", [EXPIRED, STARTED], None, Confirmation(confirmed=False), 0.0),
        ("mqtt", [RECEIVED], STARTED, Confirmation(confirmed=False), 1.0),
        ("mqtt", None, STARTED, Confirmation(confirmed=True), 0.5),
        ("xmpp", [STARTED], None, Confirmation(confirmed=True), 0.0),
        ("xmpp", [RECEIVED], FAILED, Confirmation(confirmed=False, reason=STALE), 0.5),
        ("xmpp", [], None, Confirmation(confirmed=False), 1.0),
        ("http", [STARTED], None, Confirmation(confirmed=False), 1.0),
        ("http", [], STARTED, Confirmation(confirmed=True), 0.5),
    ],
)
def test_the_first_decisive_ack_of_bus_and_tables_is_the_answer(  # noqa: PLR0917 (parameters)
    polled_mailbox: PolledMailbox,
    transport: Literal["mqtt", "xmpp", "http"],
    on_bus: Sequence[AckStatus] | None,
    in_tables: AckStatus | None,
    answer: Confirmation,
    ends_s: float,
) -> None:
    bus, relay = cast("Any", AckBus(on_bus)), cast("Any", Relay())
    delivery = Delivery(bus=bus, mailbox=polled_mailbox, relay=relay, tracing=NoTracing())
    loop = polled_mailbox.loop

    async def store() -> None:
        await asyncio.sleep(0.5)
        if in_tables is not None:
            await polled_mailbox.store_ack(ARM.agent, ack(in_tables))

    async def send() -> Confirmation:
        storing = loop.create_task(store())
        confirmation = await delivery.send_confirmed(replace(ARM, transport=transport), SIGNED, wait_ms=1000)
        assert polled_mailbox._waiting == {}, "no task waits any longer"
        assert loop.time() == pytest.approx(ends_s, abs=0.0001)
        await storing
        return confirmation

    assert loop.complete(send()) == answer
    if transport == "mqtt" and on_bus is not None:
        assert (polled_mailbox.tables.rows(records.MAILBOX), polled_mailbox.read_s) == ([], [])


def test_without_a_wait_no_ack_is_expected(polled_mailbox: PolledMailbox) -> None:
    tracing, unused = SpanNames(), cast("Any", None)
    delivery = Delivery(bus=unused, mailbox=polled_mailbox, relay=unused, tracing=tracing)
    for wait_ms, count in ((0, 1), (10, 2)):
        polled_mailbox.loop.complete(delivery.send_confirmed(ARM, SIGNED, wait_ms=wait_ms))
        rows = [row for _, row in polled_mailbox.tables.rows(records.MAILBOX)]
        assert [row.data["expires_ms"] for row in rows] == [SIGNED.expires_ms] * count
    assert tracing.names == ["publish command", "await acks"] * 2


class SpanNames(NoTracing):
    """Records the names of spans."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def span(self, name: str, /) -> contextlib.AbstractContextManager[None]:  # type: ignore[override]
        self.names.append(name)
        return contextlib.nullcontext()


class Relay:
    """Records relayed messages."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, topics.Topic, bytes]] = []

    async def publish(self, messages: Iterable[tuple[str, topics.Topic, bytes]]) -> None:
        self.messages += messages


class Bus:
    """Records published messages."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, bytes]] = []

    async def publish(self, topic: str, payload: bytes) -> None:
        self.messages.append((topic, payload))


@pytest.mark.parametrize(("transport", "published", "relayed"), [("mqtt", 2, 0), ("xmpp", 0, 2), ("http", 0, 0)])
def test_each_transport_gets_commands_and_stops_in_its_own_way(
    transport: Literal["mqtt", "xmpp", "http"], published: int, relayed: int
) -> None:
    tables, clock, relay, bus = MemoryTables(), SystemClock(), Relay(), Bus()
    retention = Retention(tables=tables, blobs=MemoryBlobs(now_s=time.time))
    mailbox = Mailbox(tables=tables, retention=retention, clock=clock)
    used: Any = None if transport == "mqtt" else mailbox
    delivery = Delivery(bus=cast("Any", bus), mailbox=used, relay=cast("Any", relay), tracing=NoTracing())
    device = replace(ARM, transport=transport)
    signed = SIGNED._replace(first=True)

    async def send() -> int:
        await delivery.send(device, signed)
        await delivery.stop(device, "author", b"stop")
        rows = (await tables.query(records.MAILBOX, ARM.agent, limit=9)).rows
        assert [row.key[0] for row in rows] == ["0"] * len(rows), "a Stop comes first"
        stored = len(rows)
        await delivery.withdraw(device, signed.command)
        assert not (await tables.query(records.MAILBOX, ARM.agent, limit=9)).rows
        return stored

    assert asyncio.run(send()) == (transport != "mqtt")
    expected = [(f"{ARM.topic}/cmd", b"{}"), (f"{ARM.topic}/stop/author", b"stop")]
    assert bus.messages == expected[:published]
    assert relay.messages == [(topic, topics.parse(topic), payload) for topic, payload in expected[:relayed]]
