"""Relayed messages: order, quality of service, retention, and the pause after a failure."""

import asyncio
from collections.abc import Iterator
from typing import Any, cast

import pytest

from device_agent.protocol import codec, topics
from function_app.ports.command_bus import BusUnavailable
from function_app.services.messaging.broker_relay import PAUSE_MS, TIMEOUT_S, BrokerRelay
from tests.fakes.clock import MemoryClock
from tests.fakes.event_loop import VirtualTimeLoop

ARM = "ts/v1/s/aaaaaaaaaa/arm/"
STATE, EVENT, HEAT = ARM + "state", ARM + "event", ARM + "tele/heat"


class Bus:
    """Records messages; may be slow or away."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes, int, bool]] = []
        self.takes_s = 0.0
        self.reachable = True

    async def publish(self, topic: str, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        await asyncio.sleep(self.takes_s)
        if not self.reachable:
            raise BusUnavailable("away")
        self.sent.append((topic, payload, qos, retain))


class RelayFixture:
    """A relay in virtual time."""

    def __init__(self) -> None:
        self.clock, self.bus = MemoryClock(), Bus()
        self.loop = VirtualTimeLoop(self.clock)
        self.relay = BrokerRelay(bus=cast("Any", self.bus), clock=self.clock)

    def publish(self, *messages: tuple[str, bytes]) -> None:
        parsed = [(topic, topics.parse(topic), payload) for topic, payload in messages]
        self.loop.complete(self.relay.publish(parsed))

    def is_paused(self) -> bool:
        before = len(self.bus.sent)
        self.publish((EVENT, b"probe"))
        return len(self.bus.sent) == before


@pytest.fixture
def fixture() -> Iterator[RelayFixture]:
    fixture = RelayFixture()
    yield fixture
    fixture.loop.end()


@pytest.mark.parametrize(
    ("topic", "qos", "retain"),
    [
        ("ts/v1/s/aaaaaaaaaa/conn", 1, True),
        (ARM + "desc", 1, True),
        (STATE, 1, True),
        (EVENT, 1, False),
        (ARM + "ack", 1, False),
        (HEAT, 0, False),
        (ARM + "stored", 0, False),
    ],
)
def test_each_class_has_its_quality_of_service(fixture: RelayFixture, topic: str, qos: int, retain: bool) -> None:
    fixture.publish((topic, b"x"))
    assert fixture.bus.sent == [(topic, b"x", qos, retain)]


def test_topics_are_published_concurrently_and_each_in_order(fixture: RelayFixture) -> None:
    fixture.bus.takes_s = 0.7
    fixture.publish((STATE, b"1"), (EVENT, b"2"), (STATE, b"3"))
    assert [payload for _, payload, _, _ in fixture.bus.sent] == [b"1", b"2", b"3"]
    assert fixture.loop.time() == pytest.approx(1.4)


def test_only_a_retained_message_may_be_too_long(fixture: RelayFixture) -> None:
    longest, longer = (b"x" * (codec.MAX_RETAINED_BYTES + more) for more in (0, 1))
    fixture.publish((STATE, longest), (STATE, longer), (STATE, b"next"), (EVENT, longer))
    sent = [(topic, payload) for topic, payload, _, _ in fixture.bus.sent]
    assert sorted(sent) == sorted([(STATE, longest), (STATE, b"next"), (EVENT, longer)])


@pytest.mark.parametrize("failure", ["away", "slow"])
def test_after_a_failure_publishing_pauses_for_five_seconds(fixture: RelayFixture, failure: str) -> None:
    fixture.bus.reachable, fixture.bus.takes_s = failure != "away", 3.0 if failure == "slow" else 0.0
    fixture.publish((STATE, b"x"))
    assert fixture.loop.time() == (TIMEOUT_S if failure == "slow" else 0.0)
    fixture.bus.reachable, fixture.bus.takes_s = True, 0.0
    assert fixture.is_paused()
    fixture.clock.advance(PAUSE_MS / 1000 - 0.001)
    assert fixture.is_paused()
    fixture.clock.advance(0.001)
    assert not fixture.is_paused()


def test_a_clock_that_was_set_back_does_not_prolong_the_pause(fixture: RelayFixture) -> None:
    fixture.bus.reachable = False
    fixture.publish((STATE, b"x"))
    fixture.bus.reachable = True
    fixture.clock.advance(-0.001)
    assert not fixture.is_paused()
