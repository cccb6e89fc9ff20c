"""Periodic reads: all messages arrive in order, with few wake-ups of the process."""

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
def reads_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Start times of the reads [s]."""
    starts: list[float] = []
    start_reading = event_loop._PeriodicReader._start_reading

    def observed(reader: event_loop._PeriodicReader) -> None:
        starts.append(time.monotonic())
        start_reading(reader)

    monkeypatch.setattr(event_loop._PeriodicReader, "_start_reading", observed)
    return starts


@pytest.mark.anyio
async def test_all_messages_arrive_in_order_and_in_few_reads(broker: RunningBroker, reads_s: list[float]) -> None:
    received: list[int] = []
    at = Broker(host=HOST, port=broker.tcp_port, credentials=broker.access.service_credentials)
    link = MqttConnection(
        at, subscriptions=(TOPIC,), receive=lambda message: received.append(int(message.payload)), every_s=EVERY_S
    )
    try:
        assert await link.ready(PATIENCE_S), link.problem
        began_s, before = time.monotonic(), len(reads_s)
        with await asyncio.to_thread(broker.client, "rounds", publish=(TOPIC,)) as robot:
            for number in range(COUNT):
                robot.publish(TOPIC, str(number).encode(), qos=1)
                await asyncio.sleep(0.003)
            async with asyncio.timeout(PATIENCE_S):
                while len(received) < COUNT:  # noqa: ASYNC110 (any may be the last)
                    await asyncio.sleep(EVERY_S / 10)
        rounds, took_s = len(reads_s) - before, time.monotonic() - began_s
        assert received == list(range(COUNT))
        assert 1 <= rounds <= took_s / EVERY_S + 2
        assert min(later - earlier for earlier, later in pairwise(reads_s)) >= 0.9 * EVERY_S
    finally:
        await link.close()


@pytest.fixture
def stoppable(tmp_path: Path) -> Iterator[RunningBroker]:
    with start_broker("mosquitto", tmp_path) as broker:
        yield broker


@pytest.mark.anyio
async def test_it_sleeps_between_messages_and_detects_a_lost_broker(
    stoppable: RunningBroker, reads_s: list[float]
) -> None:
    at = Broker(host=HOST, port=stoppable.tcp_port, credentials=stoppable.access.service_credentials)
    link = MqttConnection(at, subscriptions=(TOPIC,), every_s=EVERY_S)
    try:
        assert await link.ready(PATIENCE_S), link.problem
        await asyncio.sleep(3 * EVERY_S)
        before = len(reads_s)
        await asyncio.sleep(5 * EVERY_S)
        assert len(reads_s) == before
        await asyncio.to_thread(stoppable.stop)
        async with asyncio.timeout(PATIENCE_S):
            while not link.problem:  # noqa: ASYNC110 (no event exists for it)
                await asyncio.sleep(EVERY_S / 10)
    finally:
        await link.close()
