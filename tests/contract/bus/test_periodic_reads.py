"""What is stored is read in rounds: everything arrives, in order, and the process wakes seldom for it."""

import asyncio
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from function_app.adapters.mqtt import event_loop
from function_app.adapters.mqtt.connection import Broker, MqttConnection
from tests.harness.network.brokers import HOST, PATIENCE_S, RunningBroker, start_broker

EVERY_S = 0.2
TOPIC = "ts/v1/rounds/bench/arm/tele/joints"
COUNT = 300


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """When each round began."""
    moments: list[float] = []
    begin = event_loop._Unhurried._begin

    def watched(reader: event_loop._Unhurried) -> None:
        moments.append(time.monotonic())
        begin(reader)

    monkeypatch.setattr(event_loop._Unhurried, "_begin", watched)
    return moments


@pytest.mark.anyio
async def test_all_of_it_comes_in_order_and_in_few_rounds(broker: RunningBroker, begun: list[float]) -> None:
    heard: list[int] = []
    at = Broker(host=HOST, port=broker.tcp_port, credentials=broker.access.service_credentials)
    link = MqttConnection(
        at, subscriptions=(TOPIC,), receive=lambda message: heard.append(int(message.payload)), every_s=EVERY_S
    )
    try:
        assert await link.ready(PATIENCE_S), link.trouble
        began_s, before = time.monotonic(), len(begun)
        with await asyncio.to_thread(broker.client, "rounds", publish=(TOPIC,)) as robot:
            for number in range(COUNT):
                robot.publish(TOPIC, str(number).encode(), qos=1)
                await asyncio.sleep(0.003)
            async with asyncio.timeout(PATIENCE_S):
                while len(heard) < COUNT:  # noqa: ASYNC110 (any of them may be the last)
                    await asyncio.sleep(EVERY_S / 10)
        rounds, took_s = len(begun) - before, time.monotonic() - began_s
        assert heard == list(range(COUNT))
        assert 1 <= rounds <= took_s / EVERY_S + 2
        assert min(later - earlier for earlier, later in pairwise(begun)) >= 0.9 * EVERY_S
    finally:
        await link.close()


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[RunningBroker]:
    """A broker that the test may end."""
    with start_broker("mosquitto", tmp_path) as broker:
        yield broker


@pytest.mark.anyio
async def test_between_messages_it_sleeps_and_a_lost_broker_is_noticed(
    mortal: RunningBroker, begun: list[float]
) -> None:
    at = Broker(host=HOST, port=mortal.tcp_port, credentials=mortal.access.service_credentials)
    link = MqttConnection(at, subscriptions=(TOPIC,), every_s=EVERY_S)
    try:
        assert await link.ready(PATIENCE_S), link.trouble
        await asyncio.sleep(3 * EVERY_S)
        before = len(begun)
        await asyncio.sleep(5 * EVERY_S)
        assert len(begun) == before, "nothing has come"
        await asyncio.to_thread(mortal.stop)
        async with asyncio.timeout(PATIENCE_S):
            while not link.trouble:  # noqa: ASYNC110 (nothing tells of it)
                await asyncio.sleep(EVERY_S / 10)
    finally:
        await link.close()
