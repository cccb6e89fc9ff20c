"""Devices that are unreachable, send invalid values or have stopped themselves: the agent holds and reports it."""

import math
from dataclasses import replace

import pytest

from device_agent.ports.driver import DriverFault, Observation, Twist, UnreachableError
from device_agent.protocol import Mode, MoveJoints, ResetStop, State, topics
from device_agent.runtime.control import measurement
from tests.fakes.drivers import BASE, FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.conftest import MakeDevice

MOVE = MoveJoints(position_rad={"elbow": 0.1}, speed=1.0)
PROTECTIVE_STOP = DriverFault("protective-stop", "the arm hit something; release it at the pendant")
WARM = DriverFault("warm", "the elbow is warm", stops=False)
VALID = Observation((0.1, 0.2), (0.0, 0.0), (0.0, 0.0), ())


class RealDriver(FakeDriver):
    """A device that may be off, and that reports faults itself."""

    simulated = False

    def __init__(self, *, off: bool = False) -> None:
        super().__init__()
        self.off = off
        self.present: tuple[DriverFault, ...] = ()
        self.sent = 0
        self.observation: Observation | None = None

    def connect(self) -> None:
        if self.off:
            raise UnreachableError("no answer from the arm; is it switched on?")
        super().connect()

    def observe(self) -> Observation:
        return self.observation or super().observe()

    def send(self, position_rad):
        self.sent += 1
        return super().send(position_rad)

    def faults(self) -> tuple[DriverFault, ...]:
        return self.present


class RealBase(RealDriver):
    def drive(self, twist: Twist) -> Twist:
        return twist


def state(harness: DeviceHarness) -> State:
    states: list[State] = harness.published(topics.STATE, State)
    return states[-1] if states else State(device="arm", at_ms=0, tick_ms=0, mode=Mode.IDLE, epoch=0)


def codes(harness: DeviceHarness) -> list[str]:
    return [fault.code for fault in state(harness).faults]


def test_the_agent_starts_without_an_unreachable_device_and_moves_it_only_after_it_responds(
    make_device: MakeDevice,
) -> None:
    driver = RealDriver(off=True)
    driver.position = (0.3, 0.4)
    harness = make_device(driver=driver)
    eventually(lambda: state(harness).mode is Mode.FAULT and codes(harness) == ["driver"])
    assert "switched on" in state(harness).faults[0].message
    assert harness.failed(MOVE, epoch=1).code == "fault"
    assert driver.sent == 0
    driver.off = False
    eventually(lambda: state(harness).mode is Mode.IDLE)
    assert harness.telemetry().commanded_rad == (0.3, 0.4), "it holds where it is, not at its home position"
    eventually(lambda: not state(harness).faults)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (replace(VALID, position_rad=(math.nan, 0.0)), "positions that are not finite"),
        (replace(VALID, velocity_rad_s=(math.inf, -math.inf)), "velocities that are not finite"),
        (replace(VALID, effort_nm=(0.0,)), "1 efforts for 2 joints"),
        (replace(VALID, at_s=-2.0), "no new values for"),
    ],
)
def test_an_invalid_measurement_is_a_fault_until_a_valid_one(
    make_device: MakeDevice, observation: Observation, message: str
) -> None:
    driver = RealDriver()
    harness = make_device(driver=driver)
    driver.observation = observation
    eventually(lambda: state(harness).mode is Mode.FAULT)
    eventually(lambda: any(message in fault.message for fault in state(harness).faults))
    sent = driver.sent
    assert harness.failed(MOVE, epoch=1).code == "fault"
    assert driver.sent == sent
    driver.observation = None
    eventually(lambda: state(harness).mode is Mode.IDLE)


def test_a_recent_measurement_is_valid() -> None:
    for at_s in (None, 10.0 - measurement.STALE_S, 10.0):
        measurement.check(replace(VALID, at_s=at_s), joints=2, now_s=10.0)


@pytest.mark.parametrize("driver_class", [RealDriver, RealBase])
def test_a_device_that_stops_itself_latches_stop_and_receives_no_commands(
    make_device: MakeDevice, driver_class: type[RealDriver]
) -> None:
    driver = driver_class()
    kind = robot_type(BASE) if driver_class is RealBase else robot_type()
    harness = make_device(driver=driver, kind=kind)
    driver.present = (WARM, PROTECTIVE_STOP)
    eventually(lambda: codes(harness) == ["driver.warm", "driver.protective-stop"])
    assert state(harness).mode is Mode.FAULT
    latch = state(harness).stop
    assert latch is not None
    assert (latch.caller, latch.reason) == ("the device", PROTECTIVE_STOP.message)
    sent = driver.sent
    driver.position = (0.5, -0.5)  # pushed by hand
    eventually(lambda: harness.telemetry().position_rad == (0.5, -0.5))
    assert harness.telemetry().mode is Mode.FAULT
    assert harness.telemetry().commanded_rad == (0.5, -0.5)
    refusal = harness.failed(ResetStop(), epoch=2)
    assert refusal.code == "device_stopped"
    assert PROTECTIVE_STOP.message in refusal.message
    assert state(harness).stop == latch
    assert not harness.events("stop-reset")
    assert harness.failed(MOVE, epoch=2).code == "lease_ended", "the epoch of a rejected reset has ended too"
    assert driver.sent == sent
    driver.present = ()
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)
    assert harness.failed(MOVE, epoch=3).code == "stopped"
    assert driver.position == (0.5, -0.5), "it holds where it was pushed to"
    harness.done(ResetStop(), epoch=4)
    harness.done(MOVE, epoch=5)


def test_a_stop_of_an_operator_stays_the_one_that_is_shown(make_device: MakeDevice) -> None:
    driver = RealDriver()
    harness = make_device(driver=driver)
    harness.receive_stop()
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)
    latch = harness.device._controller.latch
    driver.present = (PROTECTIVE_STOP,)
    eventually(lambda: harness.telemetry().mode is Mode.FAULT)
    assert harness.device._controller.latch == latch


def test_other_faults_of_a_device_are_shown_and_it_moves(make_device: MakeDevice) -> None:
    driver = RealDriver()
    harness = make_device(driver=driver)
    driver.present = (WARM,)
    eventually(lambda: codes(harness) == ["driver.warm"])
    harness.done(MOVE, epoch=1)
    assert state(harness).stop is None


def test_faults_of_a_lost_device_are_unknown(make_device: MakeDevice) -> None:
    driver = RealDriver()
    harness = make_device(driver=driver)
    driver.present = (WARM,)
    eventually(lambda: codes(harness) == ["driver.warm"])
    driver.off = driver.broken = True
    eventually(lambda: codes(harness) == ["driver"])
