"""Stream sampling: rates, values, errors and use in scripts and interlocks."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.driver import DriverError
from device_agent.protocol import Measurements, Stream, codec, topics
from device_agent.runtime.telemetry.stream_sampler import StreamSampler
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import play

WITHIN_S = 60.0
JOINTS, SONAR, HEALTH = (Stream(name=name, rate_hz=100.0) for name in ("joints", "sonar", "health"))
Answer = Callable[[], Mapping[str, float | bool]]


class Gauge(FakeDriver):
    """A driver with preset measurements."""

    def __init__(self, **answers: Answer) -> None:
        super().__init__()
        self.answers = answers
        self.asked: list[str] = []

    def report(self, stream: str) -> Mapping[str, float | bool]:
        self.asked.append(stream)
        return self.answers[stream]()


class Bell:
    """Keeps what was told, and waits for more."""

    def __init__(self) -> None:
        self.told: list[tuple[str, Measurements]] = []
        self._more = threading.Condition()

    def __call__(self, stream: str, measured: Measurements) -> None:
        with self._more:
            self.told.append((stream, measured))
            self._more.notify_all()

    def of(self, stream: str) -> list[Measurements]:
        return [measured for name, measured in self.told if name == stream]

    def wait(self, stream: str, count: int) -> list[Measurements]:
        with self._more:
            assert self._more.wait_for(lambda: len(self.of(stream)) >= count, WITHIN_S)
            return self.of(stream)


def run(gauge: Gauge | None, *streams: Stream, tell: Callable[[str, Measurements], None]) -> StreamSampler:
    reporter = StreamSampler(streams, gauge, name="cart", publish=tell)
    reporter.start()
    return reporter


def test_each_stream_except_joints_is_sampled_and_numbered() -> None:
    gauge, bell = Gauge(sonar=lambda: {"distance_m.left": 0.8}, health=lambda: {"charging": True}), Bell()
    reporter = run(gauge, JOINTS, SONAR, HEALTH, tell=bell)
    sonar, health = bell.wait("sonar", 3), bell.wait("health", 3)
    reporter.stop()
    reporter.stop()
    assert [measured.sequence for measured in sonar[:3]] == [1, 2, 3]
    assert sonar[0].values == {"distance_m.left": 0.8}
    assert health[0].values == {"charging": True}
    assert "joints" not in gauge.asked
    assert reporter.latest()["sonar"].values == {"distance_m.left": 0.8}
    assert 0 <= reporter.latest()["sonar"].age_s < WITHIN_S


def test_each_stream_has_its_own_rate() -> None:
    fast, slow = Stream(name="fast", rate_hz=200.0), Stream(name="slow", rate_hz=0.01)
    gauge, bell = Gauge(fast=lambda: {"a": 1.0}, slow=lambda: {"a": 1.0}), Bell()
    reporter = run(gauge, fast, slow, tell=bell)
    bell.wait("fast", 20)
    reporter.stop()
    assert len(bell.of("slow")) == 1


def test_values_that_are_not_finite_and_empty_readings_are_not_published() -> None:
    gauge = Gauge(sonar=lambda: {"a": math.nan, "b": math.inf, "c": 0.5}, health=lambda: {"a": math.nan})
    bell = Bell()
    reporter = run(gauge, SONAR, HEALTH, tell=bell)
    told = bell.wait("sonar", 2)
    reporter.stop()
    assert told[0].values == {"c": 0.5}
    assert bell.of("health") == []
    assert gauge.asked.count("health") > 0


def test_an_error_of_one_stream_is_logged_once_and_does_not_stop_others(caplog: pytest.LogCaptureFixture) -> None:
    well = threading.Event()

    def broken() -> Mapping[str, float | bool]:
        if well.is_set():
            return {"a": 1.0}
        raise DriverError("no answer from the sonar")

    gauge, bell = Gauge(sonar=broken, health=lambda: {"a": 1 / 0}), Bell()
    with caplog.at_level(logging.WARNING):
        reporter = run(gauge, SONAR, HEALTH, tell=bell)
        while gauge.asked.count("sonar") < 5:
            time.sleep(0.005)
        well.set()
        bell.wait("sonar", 1)
        reporter.stop()
    told = [record.getMessage() for record in caplog.records]
    assert told.count("cart: stream sonar: no answer from the sonar") == 1
    assert told.count("cart: stream sonar: works again") == 1
    assert sum("internal error: ZeroDivisionError" in text for text in told) == 1


def test_a_driver_without_streams_is_not_polled() -> None:
    bell = Bell()
    for reporter in (run(None, SONAR, tell=bell), run(Gauge(), JOINTS, tell=bell)):
        reporter.stop()
        assert reporter.latest() == {}
    assert bell.told == []


def test_a_device_publishes_its_streams(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), streams=(SONAR,))
    harness = DeviceHarness(tmp_path, kind=kind, driver=Gauge(sonar=lambda: {"distance_m": 0.8}))
    harness.device.start()
    try:
        deadline_s = time.monotonic() + WITHIN_S
        while not any(topic.endswith("/tele/sonar") for topic, _ in list(harness.said)):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
    finally:
        harness.stop()
    payload = next(payload for topic, payload in harness.said if topics.parse(topic).name == "sonar")
    assert codec.decode(payload, Measurements).values == {"distance_m": 0.8}


def test_a_script_reads_the_streams_of_its_robot(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), streams=(SONAR,))
    harness = DeviceHarness(tmp_path, kind=kind, driver=Gauge(sonar=lambda: {"distance_m": 0.8}))
    harness.device.start()
    lines = (
        "import time\n"
        "while 'sonar' not in robot.state()['streams']: time.sleep(0.01)\n"
        "sonar = robot.state()['streams']['sonar']\n"
        "print(sonar['values'], sonar['age_s'] >= 0)\n"
    )
    assert play(harness, lines) == "{'distance_m': 0.8} True\n"
    harness.stop()


def test_an_interlock_can_use_the_robots_own_stream(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), streams=(SONAR,))
    near = InterlockRule(device="arm", stream="sonar", field="distance_m", below=0.5)
    away_m = [0.8]
    harness = DeviceHarness(
        tmp_path, kind=kind, driver=Gauge(sonar=lambda: {"distance_m": away_m[0]}), interlocks=[near]
    )
    harness.device.start()
    eventually(lambda: not harness.device._controller.restrictions)
    away_m[0] = 0.2
    (held,) = eventually(lambda: harness.device._controller.restrictions)
    assert "distance_m" in held.why
    harness.stop()


class Island(DeviceHarness):
    """A device whose link takes no measurement while it is down."""

    down = True

    def publish(self, topic: str, payload: bytes, **more: Any) -> bool:
        if self.down:
            return False
        return super().publish(topic, payload, **more)


def test_measurements_without_a_link_are_published_late(tmp_path: Path) -> None:
    kind = msgspec.structs.replace(robot_type(), streams=(SONAR,))
    gauge = Gauge(sonar=lambda: {"distance_m": 0.8})
    harness = Island(tmp_path, kind=kind, driver=gauge)
    harness.outbox.link_changed(False)
    harness.device.start()
    eventually(lambda: gauge.asked.count("sonar") > 5)
    harness.down = False
    harness.outbox.link_changed(True)
    late = eventually(lambda: harness.heard(topics.LATE, Measurements, "sonar"))
    assert late[0].values == {"distance_m": 0.8}
    harness.stop()
