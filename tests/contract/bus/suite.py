"""What every ``CommandBus`` keeps. A test class inherits it and gives ``stage``: the bus, and what lies behind it."""

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


class Heard(NamedTuple):
    """One message as it left the bus."""

    topic: str
    payload: bytes


@dataclass
class Stage:
    """A bus, and what lies behind it.

    Attributes:
        heard: All that has arrived so far, in order of arrival.
        kept: The retained message of a topic, or ``None``.
        away: Another bus of the same kind, to an address without a broker.
    """

    bus: CommandBus
    space: str
    heard: Callable[[], list[Heard]]
    kept: Callable[[str], bytes | None]
    away: CommandBus

    @property
    def topic(self) -> str:
        return f"ts/v1/{self.space}/agent/arm/cmd"

    async def until(self, count: int) -> list[Heard]:
        """What has arrived, as soon as it is so much."""
        deadline = time.monotonic() + PATIENCE_S
        while len(found := self.heard()) < count:
            assert time.monotonic() < deadline, f"{len(found)} of {count} messages arrived"
            await asyncio.sleep(0.01)
        return found


class BusContract:
    """Inherit and give a fixture ``stage``."""

    pytestmark = pytest.mark.anyio

    @pytest.mark.parametrize("qos", [0, 1])
    async def test_a_message_arrives_byte_for_byte(self, stage: Stage, qos: int) -> None:
        payload = '{"who":"grüß 🤖","n":1e2,"x":"\\u0000%2F+#"}'.encode()
        await stage.bus.publish(stage.topic, payload, qos=qos)
        assert await stage.until(1) == [Heard(stage.topic, payload)]

    async def test_the_largest_message_of_the_contract_arrives(self, stage: Stage) -> None:
        payload = b"x" * codec.MAX_BYTES
        await stage.bus.publish(stage.topic, payload)
        assert await stage.until(1) == [Heard(stage.topic, payload)]

    async def test_messages_of_one_caller_arrive_in_order(self, stage: Stage) -> None:
        for number in range(20):
            await stage.bus.publish(stage.topic, b"%d" % number)
        assert [heard.payload for heard in await stage.until(20)] == [b"%d" % number for number in range(20)]

    async def test_many_at_once_all_arrive(self, stage: Stage) -> None:
        sent = [b"%d" % number for number in range(60)]
        await asyncio.gather(*(stage.bus.publish(stage.topic, payload) for payload in sent))
        assert sorted(heard.payload for heard in await stage.until(60)) == sorted(sent)

    async def test_only_what_is_retained_is_kept_and_the_newest_of_it(self, stage: Stage) -> None:
        topics = [f"ts/v1/{stage.space}/agent/{name}/state" for name in ("kept", "passing")]
        for payload in (b"old", b"new"):
            await stage.bus.publish(topics[0], payload, retain=True)
        await stage.bus.publish(topics[1], b"passing")
        await stage.until(3)
        assert [await asyncio.to_thread(stage.kept, topic) for topic in topics] == [b"new", None]

    async def test_an_empty_message_takes_back_what_was_retained(self, stage: Stage) -> None:
        topic = f"ts/v1/{stage.space}/agent/arm/state"
        for payload in (b"here", b""):
            await stage.bus.publish(topic, payload, retain=True)
        assert [heard.payload for heard in await stage.until(2)] == [b"here", b""]
        assert not await asyncio.to_thread(stage.kept, topic)

    async def test_an_unreachable_broker_is_reported_in_time(self, stage: Stage) -> None:
        began = time.monotonic()
        with pytest.raises(BusUnavailable) as caught:
            await stage.away.publish(stage.topic, b"x")
        said = str(caught.value)
        assert "\n" not in said
        assert " cannot be reached" in said
        assert "127.0.0.1:1" in said
        assert await stage.away.status() != "ok"
        assert time.monotonic() - began < PATIENCE_S
        await stage.away.close()

    async def test_acks_are_heard_or_said_not_to_be(self, stage: Stage) -> None:
        async with stage.bus.acks(f"ts/v1/{stage.space}/agent/arm", "c1") as acks:
            assert acks is None or hasattr(acks, "__anext__")

    async def test_it_is_well_before_and_after_a_message_and_closes_twice(self, stage: Stage) -> None:
        await stage.bus.start()
        await stage.bus.publish(stage.topic, b"x")
        assert await stage.bus.status() == "ok"
        await stage.bus.close()
        await stage.bus.close()


async def beats_until(work: Awaitable[None], enough: threading.Event) -> int:
    """How often the event loop came round while ``work`` was done, which waits for ``enough``: that it did five times.

    Where the work holds up the loop it waits in vain.
    """
    beats = 0
    task = asyncio.ensure_future(work)
    while not task.done():
        await asyncio.sleep(0.01)
        beats += 1
        if beats == BEATS:
            enough.set()
    await task
    return beats


BEATS = 5
WAITS_IN_VAIN_S = 10.0
