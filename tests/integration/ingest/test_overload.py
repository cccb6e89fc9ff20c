"""The MQTT feed of measurements drops what it cannot hold, and logs it."""

import pytest

from function_app.adapters.local import device_feed
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.network.brokers import wait_until
from tests.unit.function_app.services.telemetry.test_live_data import measure, streams


def test_measurements_beyond_the_queue_limit_are_dropped_and_logged(
    cloud: Cloud, pair: tuple[Person, Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(device_feed, "MAX_COLLECTED", 10)
    cloud.start_telemetry()
    anna, robot = pair
    begin_ms = cloud.clock.now_ms() - 600_000
    for number in range(500):
        measure(robot, "health", begin_ms + 10 * number, a=1.0)
    wait_until(lambda: "health" in streams(anna, robot), "samples to be stored")
    assert streams(anna, robot)["health"]["samples"] <= 100
    assert "telemetry is behind: dropped" in caplog.text
