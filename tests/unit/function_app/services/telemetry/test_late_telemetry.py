"""Backfilled measurements of an interrupted connection are stored and not relayed to live views."""

import asyncio
import math
from typing import Any

import pytest

from device_agent.protocol import Measurements, codec, topics
from function_app.adapters.local import device_feed
from function_app.adapters.mqtt.connection import Broker
from function_app.ports.broker_access import Credentials, ServiceCredentials
from function_app.ports.tables import StoreError
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.cloud.polling import PollingRobot

HOUR_MS = 3_600_000


def late(robot: Robot | PollingRobot) -> str:
    return topics.device(robot.space, robot.id, "arm", topics.LATE, "health")


def sample(cloud: Cloud, number: int) -> Measurements:
    at_ms = cloud.clock.now_ms() - HOUR_MS + 1000 * number
    return Measurements(tick_ms=number, at_ms=at_ms, sequence=number, values={"t_c": 20.0 + number})


def stored(anna: Person, device: str) -> int:
    streams = anna.get(f"/devices/{device}/data").json()["items"]
    return sum(stream["samples"] for stream in streams if stream["name"] == "health")


def test_samples_over_mqtt_are_acknowledged_and_stored_once(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.start_late()
    samples = [sample(cloud, number) for number in range(60)]
    for each in (*samples, *samples[:20]):
        robot.publish(late(robot), each)
    assert stored(anna, robot.device) == 60
    newest = anna.get(f"/devices/{robot.device}/data/health", params={"resolution": "raw"}).json()
    assert newest["at_ms"] == [each.at_ms for each in samples]


def test_samples_over_http_are_stored_and_not_relayed(cloud: Cloud, broker: MemoryBroker) -> None:
    anna = cloud.sign_in("anna")
    with PollingRobot(cloud) as robot:
        robot.pair(anna)
        live = topics.device(robot.space, robot.id, "arm", topics.TELE, "health")
        messages = [(late(robot), codec.encode(sample(cloud, 1))), (live, codec.encode(sample(cloud, 2)))]
        own = cloud.functions.mqtt_credentials._access.service_credentials()
        login = Credentials(own.username, own.password)
        with broker.connect(own.client_id, login) as subscriber:
            subscriber.subscribe(late(robot), live)
            assert [result["status"] for result in robot.post_raw(*messages).json()["results"]] == ["stored"] * 2
            assert subscriber.receive().topic == live
            assert subscriber.pending() == []
        assert stored(anna, robot.device) == 2


def test_ingest_is_retried_until_the_store_is_available(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_feed, "COLLECT_S", 0.01)
    batches: list[int] = []

    async def store(batch: Any) -> None:
        batches.append(len(batch))
        if len(batches) < 20:
            raise StoreError("the store is not available")

    feed = device_feed.MqttTelemetryFeed(
        Broker(host="127.0.0.1", port=1, credentials=lambda: ServiceCredentials("", "", "", math.inf)), late=True
    )
    asyncio.run(feed.store([("t", b"")], store))
    assert batches == [1] * 20
