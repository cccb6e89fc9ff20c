"""Contract of ``CommandBus``. A test class inherits it and supplies ``stage``: the bus and its broker."""

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import NamedTuple

import pytest

from device_agent.protocol import codec
from function_app.ports.command_bus import BusUnavailable, CommandBus
from tests.harness.network.brokers import PATIENCE_S


class Sent(NamedTuple):
    """A published message."""

    topic: str
    payload: bytes


@dataclass
class Stage:
    """A bus and its broker.

    Attributes:
        sent: All published messages, in order.
        retained: The retained message of a topic, or ``None``.
        unreachable: A bus of the same kind with an address without a broker.
    """

    bus: CommandBus
    space: str
    sent: Callable[[], list[Sent]]
    retained: Callable[[str], bytes | None]
    unreachable: CommandBus

    @property
    def topic(self) -> str:
        return f"ts/v1/{self.space}/agent/arm/cmd"

    async def until(self, count: int) -> list[Sent]:
        """Wait for ``count`` messages and return them."""
        deadline = time.monotonic() + PATIENCE_S
        while len(messages := self.sent()) < count:
            assert time.monotonic() < deadline, f"{len(messages)} of {count} messages published"
            await asyncio.sleep(0.01)
        return messages


class BusContract:
    """Contract of ``CommandBus``."""

    pytestmark = pytest.mark.anyio

    async def test_messages_arrive_in_order_unchanged_up_to_the_largest(self, stage: Stage) -> None:
        payloads = ['{"who":"grüß 🤖","n":1e2,"x":"\\u0000%2F+#"}'.encode(), b"x" * codec.MAX_BYTES]
        payloads += [b"%d" % number for number in range(20)]
        for number, payload in enumerate(payloads):
            await stage.bus.publish(stage.topic, payload, qos=number % 2)
        assert await stage.until(len(payloads)) == [Sent(stage.topic, payload) for payload in payloads]

    async def test_concurrent_messages_all_arrive(self, stage: Stage) -> None:
        payloads = [b"%d" % number for number in range(60)]
        await asyncio.gather(*(stage.bus.publish(stage.topic, payload) for payload in payloads))
        assert sorted(message.payload for message in await stage.until(60)) == sorted(payloads)

    async def test_the_newest_retained_message_is_stored_until_an_empty_one(self, stage: Stage) -> None:
        retained, cleared, passing = (f"ts/v1/{stage.space}/agent/{name}/state" for name in ("a", "b", "c"))
        for topic, payload in ((retained, b"old"), (retained, b"new"), (cleared, b"old"), (cleared, b"")):
            await stage.bus.publish(topic, payload, retain=True)
        await stage.bus.publish(passing, b"passing")
        assert [message.payload for message in await stage.until(5)] == [b"old", b"new", b"old", b"", b"passing"]
        found = [await asyncio.to_thread(stage.retained, topic) or None for topic in (retained, cleared, passing)]
        assert found == [b"new", None, None]

    async def test_an_unreachable_broker_is_reported_in_time(self, stage: Stage) -> None:
        began = time.monotonic()
        with pytest.raises(BusUnavailable) as caught:
            await stage.unreachable.publish(stage.topic, b"x")
        text = str(caught.value)
        assert "\n" not in text
        assert " cannot be reached" in text
        assert "127.0.0.1:1" in text
        assert await stage.unreachable.status() != "ok"
        assert time.monotonic() - began < PATIENCE_S
        await stage.unreachable.close()

    async def test_acks_are_received_or_reported_as_unavailable(self, stage: Stage) -> None:
        async with stage.bus.acks(f"ts/v1/{stage.space}/agent/arm", "c1") as acks:
            assert acks is None or hasattr(acks, "__anext__")

    async def test_status_is_ok_and_close_is_idempotent(self, stage: Stage) -> None:
        await stage.bus.start()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"
        await stage.bus.close()
        await stage.bus.close()


ITERATIONS = 5
MAX_BLOCKED_S = 10.0


async def assert_loop_is_free(work: Awaitable[None], release: threading.Event) -> None:
    """Check that the event loop runs while ``work`` waits for ``release``.

    Work that blocks the loop would never be released.
    """
    iterations = 0
    task = asyncio.ensure_future(work)
    while not task.done():
        await asyncio.sleep(0.01)
        iterations += 1
        if iterations == ITERATIONS:
            release.set()
    await task
    assert iterations >= ITERATIONS
