"""The indicator of recorded cameras: confirmation, repetition, failures, and its end."""

import pytest

from device_agent.config.agent_config import Indicator
from device_agent.runtime.errors import INTERNAL_ERROR, Refused
from device_agent.runtime.recording.camera_indicator import REPEAT_S, RETRY_S, VALID_S, CameraIndicator
from tests.harness.agent.device_harness import eventually


def _nothing() -> None:
    pass


class Lamp:
    """A room device with a control ``light``."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self.error: Exception | None = None
        self.on_set = _nothing
        self.dim = 1.0

    def set(self, control: str, value: float) -> float:
        assert control == "light"
        self.on_set()
        if self.error is not None:
            raise self.error
        self.values.append(value)
        return value * self.dim


class Fixture:
    """An indicator without its thread, and its clock."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.lamp = Lamp()
        settings = Indicator(device="lamp", control="light", on=0.8)
        self.indicator = CameraIndicator(settings, {"lamp": self.lamp}, clock_s=lambda: self.now_s)  # type: ignore[dict-item]

    def after(self, seconds: float) -> list[float]:
        """The values that are set then."""
        self.now_s += seconds
        before = len(self.lamp.values)
        self.indicator.step()
        return self.lamp.values[before:]


@pytest.fixture
def fixture() -> Fixture:
    return Fixture()


def test_it_is_switched_off_at_the_start_because_a_crash_may_have_left_it_on(fixture: Fixture) -> None:
    assert fixture.after(0.0) == [0.0]
    assert fixture.after(100.0) == []
    assert not fixture.indicator.shown


def test_it_is_on_once_its_device_has_confirmed_and_covers_only_later_pictures(fixture: Fixture) -> None:
    fixture.indicator.require(True)
    assert not fixture.indicator.covers(fixture.now_s)
    assert fixture.after(1.0) == [0.8]
    assert fixture.indicator.covers(fixture.now_s)
    assert not fixture.indicator.covers(fixture.now_s - 0.1)
    assert fixture.after(REPEAT_S - 0.1) == []
    assert fixture.after(0.1) == [0.8], "a lamp that was switched off is on again"
    assert fixture.indicator.covers(fixture.now_s - REPEAT_S)


def test_it_counts_as_off_as_soon_as_it_is_not_required(fixture: Fixture) -> None:
    fixture.indicator.require(True)
    fixture.after(0.0)
    fixture.indicator.require(False)
    assert not fixture.indicator.shown
    assert fixture.after(0.0) == [0.0]
    fixture.indicator.require(True)
    assert not fixture.indicator.shown
    assert fixture.after(0.0) == [0.8]


def test_a_failure_is_reported_and_tried_again(fixture: Fixture, caplog: pytest.LogCaptureFixture) -> None:
    fixture.lamp.error = Refused("sensor_failed", "the lamp does not respond")
    fixture.indicator.require(True)
    for _ in range(2):
        fixture.after(RETRY_S)
        assert (fixture.indicator.shown, fixture.indicator.error) == (False, "the lamp does not respond")
    assert len(caplog.records) == 1
    fixture.lamp.error = None
    assert fixture.after(RETRY_S - 0.1) == []
    assert fixture.after(0.1) == [0.8]
    assert (fixture.indicator.shown, fixture.indicator.error) == (True, "")


def test_a_later_failure_ends_it(fixture: Fixture) -> None:
    fixture.indicator.require(True)
    fixture.after(0.0)
    fixture.lamp.error = RuntimeError("a defect")
    fixture.after(REPEAT_S)
    assert (fixture.indicator.shown, fixture.indicator.error) == (False, INTERNAL_ERROR)
    fixture.indicator.require(False)
    assert fixture.indicator.error == ""


def test_a_device_that_applies_another_value_is_no_confirmation(fixture: Fixture) -> None:
    fixture.lamp.dim = 0.4
    fixture.indicator.require(True)
    fixture.after(0.0)
    assert fixture.indicator.error == "'lamp' has set light to 0.32 instead of 0.8"
    fixture.lamp.dim = 0.9
    fixture.after(RETRY_S)
    assert fixture.indicator.shown


def test_without_a_new_confirmation_it_counts_as_off(fixture: Fixture) -> None:
    fixture.indicator.require(True)
    fixture.after(0.0)
    fixture.now_s += VALID_S
    assert not fixture.indicator.shown


def test_a_change_while_the_device_responds_slowly_is_not_lost(fixture: Fixture) -> None:
    fixture.lamp.on_set = lambda: fixture.indicator.require(False)
    fixture.indicator.require(True)
    assert fixture.after(0.0) == [0.8]
    assert not fixture.indicator.shown
    assert fixture.after(0.0) == [0.0]


def test_its_thread_sets_it_and_its_end_switches_it_off(fixture: Fixture) -> None:
    fixture.indicator.require(True)
    fixture.indicator.start()
    eventually(lambda: fixture.indicator.shown)
    fixture.indicator.stop()
    fixture.indicator.stop()
    fixture.indicator.require(True)
    assert (fixture.lamp.values, fixture.indicator.shown) == ([0.8, 0.0], False)
