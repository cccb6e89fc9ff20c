"""Commands and Stops by transport; waiting for an ack ends at its time limit, also during mailbox changes."""

import asyncio
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal, cast

import pytest

from device_agent.protocol import topics
from function_app.adapters.local.clock import SystemClock
from function_app.domain.devices.devices import Device
from function_app.domain.identity.accounts import Role
from function_app.ports.monitoring import NoTracing
from function_app.services.messaging.delivery import Delivery, SignedCommand
from function_app.services.messaging.mailbox import Mailbox
from function_app.services.storage import records
from function_app.services.storage.retention import Retention
from tests.fakes.blobs import MemoryBlobs
from tests.fakes.tables import MemoryTables
from tests.unit.function_app.services.messaging.conftest import PolledMailbox

ARM = Device(
    id="aaaaaaaaaa-arm", name="arm", label="Arm", kind="arm", robot_type="ur5", agent="aaaaaaaaaa", space="s",
    pairing="p", role=Role.OWNER, topic="ts/v1/s/aaaaaaaaaa/arm", transport="http",
)  # fmt: skip


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
    signed = SignedCommand("aaaaaaaaaa-arm-00000000000000000000", b"{}", clock.now_ms() + 5_000)

    async def send() -> int:
        await delivery.send(device, signed)
        await delivery.stop(device, "author", b"stop")
        stored = len((await tables.query(records.MAILBOX, ARM.agent, limit=9)).rows)
        await delivery.withdraw(device, signed.command)
        assert not (await tables.query(records.MAILBOX, ARM.agent, limit=9)).rows
        return stored

    assert asyncio.run(send()) == (transport != "mqtt")
    expected = [(f"{ARM.topic}/cmd", b"{}"), (f"{ARM.topic}/stop/author", b"stop")]
    assert bus.messages == expected[:published]
    assert relay.messages == [(topic, topics.parse(topic), payload) for topic, payload in expected[:relayed]]
