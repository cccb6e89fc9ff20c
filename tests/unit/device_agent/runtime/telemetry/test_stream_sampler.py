"""Stream sampling: rates, values, errors and use in scripts and interlocks."""

import math
from collections.abc import Callable, Mapping

import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.ports.driver import DriverError
from device_agent.protocol import Measurements, Stream, topics
from device_agent.runtime.load import LoadGovernor
from device_agent.runtime.telemetry.stream_sampler import StreamSampler
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import eventually
from tests.harness.agent.load import raise_level
from tests.unit.device_agent.runtime.actions.robot_api_fixture import play
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.telemetry.conftest import PollClock

JOINTS, SONAR, HEALTH = (Stream(name=name, rate_hz=100.0) for name in ("joints", "sonar", "health"))
Report = Callable[[], Mapping[str, float | bool]]


class StreamDriver(FakeDriver):
    """A driver with preset measurements."""

    def __init__(self, **reports: Report) -> None:
        super().__init__()
        self.reports = reports
        self.reads: list[str] = []

    def report(self, stream: str) -> Mapping[str, float | bool]:
        self.reads.append(stream)
        return self.reports[stream]()


class SamplerFixture:
    def __init__(self, driver: StreamDriver | None, *streams: Stream) -> None:
        self.published: dict[str, list[Measurements]] = {stream.name: [] for stream in streams}
        self.load = LoadGovernor()
        self.sampler = StreamSampler(
            streams,
            driver,
            name="cart",
            publish=lambda name, measured: self.published[name].append(measured),
            load=self.load,
        )


def test_each_stream_except_joints_is_sampled_at_its_rate_and_numbered(clock: PollClock) -> None:
    slow = Stream(name="slow", rate_hz=0.5)
    driver = StreamDriver(sonar=lambda: {"distance_m.left": 0.8}, slow=lambda: {"charging": True})
    fixture = SamplerFixture(driver, JOINTS, SONAR, slow)
    clock.run(fixture.sampler, 3.0)
    sonar = fixture.published["sonar"]
    assert [measured.sequence for measured in sonar] == list(range(1, len(sonar) + 1))
    assert 295 <= len(sonar) <= 301
    assert sonar[0].values == {"distance_m.left": 0.8}
    assert [measured.values for measured in fixture.published["slow"]] == [{"charging": True}] * 2
    assert "joints" not in driver.reads
    assert fixture.sampler.latest()["slow"].values == {"charging": True}
    assert fixture.sampler.latest()["slow"].age_s == pytest.approx(1.0, abs=0.02)


def test_values_that_are_not_finite_and_empty_readings_are_not_published(clock: PollClock) -> None:
    driver = StreamDriver(sonar=lambda: {"a": math.nan, "b": math.inf, "c": 0.5}, health=lambda: {"a": math.nan})
    fixture = SamplerFixture(driver, SONAR, HEALTH)
    clock.run(fixture.sampler, 0.1)
    assert fixture.published["sonar"][0].values == {"c": 0.5}
    assert "health" in driver.reads
    assert fixture.published["health"] == []


def test_an_error_of_one_stream_is_logged_once_and_does_not_stop_others(
    clock: PollClock, caplog: pytest.LogCaptureFixture
) -> None:
    def broken() -> Mapping[str, float | bool]:
        raise DriverError("no answer from the sonar")

    driver = StreamDriver(sonar=broken, health=lambda: {"a": 1 / 0})
    fixture = SamplerFixture(driver, SONAR, HEALTH)
    clock.run(fixture.sampler, 0.1)
    driver.reports["sonar"] = lambda: {"a": 1.0}
    clock.run(fixture.sampler, 0.1)
    assert fixture.published["sonar"]
    assert [record.getMessage() for record in caplog.records] == [
        "cart: stream sonar: no answer from the sonar",
        "cart: stream health: internal error: ZeroDivisionError('division by zero')",
        "cart: stream sonar: works again",
    ]


def test_a_driver_without_streams_is_not_polled() -> None:
    for fixture in (SamplerFixture(None, SONAR), SamplerFixture(StreamDriver(), JOINTS)):
        fixture.sampler.start()
        fixture.sampler.stop()
        assert fixture.sampler.latest() == {}


def test_a_device_publishes_its_streams_late_without_a_link_and_a_script_reads_them(make_device: MakeDevice) -> None:
    driver = StreamDriver(sonar=lambda: {"distance_m": 0.8})
    harness = make_device(kind=robot_type(streams=(SONAR,)), driver=driver)
    live = eventually(lambda: harness.published(topics.TELE, Measurements, "sonar"))
    assert live[0].values == {"distance_m": 0.8}
    publish, harness.device.publisher._publish = harness.device.publisher._publish, lambda *_, **__: False
    harness.outbox.link_changed(False)
    reads = len(driver.reads)
    eventually(lambda: len(driver.reads) > reads + 5)
    harness.device.publisher._publish = publish
    harness.outbox.link_changed(True)
    late = eventually(lambda: harness.published(topics.LATE, Measurements, "sonar"))
    assert late[0].values == {"distance_m": 0.8}
    source = "sonar = robot.state()['streams']['sonar']\nprint(sonar['values'], sonar['age_s'] >= 0)\n"
    assert play(harness, source) == "{'distance_m': 0.8} True\n"


def test_an_interlock_can_use_the_robots_own_stream(make_device: MakeDevice) -> None:
    near = InterlockRule(device="arm", stream="sonar", field="distance_m", below=0.5)
    driver = StreamDriver(sonar=lambda: {"distance_m": 0.8})
    harness = make_device(kind=robot_type(streams=(SONAR,)), driver=driver, interlocks=[near])
    eventually(lambda: not harness.device._controller.restrictions)
    driver.reports["sonar"] = lambda: {"distance_m": 0.2}
    (restriction,) = eventually(lambda: harness.device._controller.restrictions)
    assert "distance_m" in restriction.why


@pytest.mark.parametrize(("level", "share"), [(2, 1.0), (3, 0.5)])
def test_an_overloaded_agent_samples_streams_less_often_at_the_last_level(
    clock: PollClock, level: int, share: float
) -> None:
    fixture = SamplerFixture(StreamDriver(sonar=lambda: {"distance_m.left": 0.8}), SONAR)
    clock.run(fixture.sampler, 4.0)
    usual = len(fixture.published["sonar"])
    raise_level(fixture.load, level)
    clock.run(fixture.sampler, 4.0)
    assert len(fixture.published["sonar"]) - usual == pytest.approx(usual * share, abs=1)
