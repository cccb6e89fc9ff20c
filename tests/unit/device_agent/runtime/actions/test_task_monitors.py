"""Monitors of measured conditions."""

import itertools

import pytest

from device_agent.protocol import Ack, Measurements, TrialCause, Verdict, codec, topics
from device_agent.protocol.manifests.measured_tasks import MeasuredSuccess
from device_agent.runtime.actions.task_monitors import MeasuredMonitor
from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import eventually
from tests.unit.device_agent.runtime.actions.trial_fixture import MANIFEST, report_of, trial
from tests.unit.device_agent.runtime.conftest import MakeDevice

ABOVE = MeasuredSuccess(device="scale", stream="weight", field="mass_kg", above=0.5, rest_s=1.0)


class Room:
    """A scale of the agent, with a clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.number = 0
        named = (("scale", "weight"),)
        self.readings = ReadingCache(space="s", agent="a", own=["scale"], named=named, clock_s=lambda: self.now_s)

    def measure(self, **values: float | bool) -> None:
        self.number += 1
        measured = Measurements(at_ms=self.number, tick_ms=self.number, sequence=self.number, values=values)
        self.readings.record("scale", "weight", measured)

    def monitor(self, success: MeasuredSuccess = ABOVE) -> MeasuredMonitor:
        return MeasuredMonitor(success, self.readings, clock_s=lambda: self.now_s)


@pytest.fixture
def room() -> Room:
    return Room()


def test_a_condition_must_hold_without_interruption(room: Room) -> None:
    room.measure(mass_kg=0.0)
    monitor = room.monitor()
    assert not monitor.state().met
    room.measure(mass_kg=0.6)
    assert not monitor.state().met
    room.now_s += 0.9
    room.measure(mass_kg=0.4)
    assert not monitor.state().met
    room.measure(mass_kg=0.6)
    assert not monitor.state().met
    room.now_s += 0.9
    assert not monitor.state().met
    room.now_s += 0.1
    room.measure(mass_kg=0.7)
    state = monitor.state()
    assert (state.met, state.time_s, state.failure) == (True, room.now_s, TrialCause.NOT_MET)
    monitor.close()


def test_an_old_or_missing_measurement_does_not_meet_it(room: Room) -> None:
    room.measure(mass_kg=0.0)
    monitor = room.monitor()
    room.measure(mass_kg=0.6)
    monitor.state()
    room.now_s += 2.1
    assert not monitor.state().met
    assert "it was no measurement" in monitor.state().detail
    room.measure(other=1.0)
    assert not monitor.state().met


@pytest.mark.parametrize(
    ("condition", "met", "not_met", "text"),
    [
        ({"above": 0.5}, 0.6, 0.5, "mass_kg > 0.5"),
        ({"below": 0.5}, 0.4, 0.5, "mass_kg < 0.5"),
        ({"equals": True}, True, False, "mass_kg = true"),
        ({"equals": 2.0}, 2.0, 2.5, "mass_kg = 2.0"),
    ],
)
def test_the_comparisons(room: Room, condition: dict[str, float], met: float, not_met: float, text: str) -> None:
    success = MeasuredSuccess(device="scale", stream="weight", field="mass_kg", rest_s=1.0, **condition)
    assert (success.met_by(met), success.met_by(not_met), success.condition) == (True, False, text)
    room.measure(mass_kg=not_met)
    assert text in room.monitor(success).state().detail


def test_a_condition_that_is_met_before_the_trial_proves_nothing(room: Room) -> None:
    room.measure(mass_kg=0.6)
    with pytest.raises(Refused, match=r"mass_kg > 0.5 is met before the trial") as raised:
        room.monitor()
    assert raised.value.code == "already_met"


def test_a_silent_sensor_is_rejected(room: Room) -> None:
    with pytest.raises(Refused, match="no measurement mass_kg of scale/weight") as raised:
        room.monitor()
    assert raised.value.code == "no_measurement"


def test_a_stream_that_the_agent_does_not_receive_is_rejected(room: Room) -> None:
    other = MeasuredSuccess(device="b-door", stream="state", field="open", equals=True, rest_s=1.0)
    with pytest.raises(Refused, match="add it under"):
        room.monitor(other)


def test_a_sensor_of_the_room_decides_about_a_real_robot(make_device: MakeDevice) -> None:
    numbers = itertools.count(1)

    def press(pressed: bool) -> None:
        number = next(numbers)
        measured = Measurements(at_ms=number, tick_ms=number, sequence=number, values={"pressed": pressed})
        harness.readings.receive(topics.Topic("s", "b", "button", topics.TELE, "state"), codec.encode(measured))

    driver = FakeDriver()
    driver.simulated = False
    harness = make_device(driver=driver, tasks=MANIFEST, room=[("b-button", "state")])
    press(False)
    request = trial(
        harness,
        "print('observed')\nwhile not robot.latest('b-button', 'state')['values']['pressed']: wait(0.01)",
        name="press_button",
        seed=None,
    )
    running = harness.running(request, epoch=1)
    # The trial is rejected if the button is pressed before the monitor is open, and it is open before the script runs.
    eventually(lambda: any("observed" in ack.output for ack in harness.acks(running)))

    def ended() -> list[Ack]:
        press(True)  # Old measurements do not count.
        return [ack for ack in harness.acks(running) if ack.status.terminal]

    report = report_of(eventually(ended)[0])
    assert (report.verdict, report.simulated) == (Verdict.SUCCESS, False)
    press(True)
    assert harness.failed(request, epoch=2).code == "already_met"
