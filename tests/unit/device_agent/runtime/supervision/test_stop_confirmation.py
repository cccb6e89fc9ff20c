"""A Stop is confirmed only when the control loop has applied it, and never by another thread."""

import threading
from collections.abc import Iterator, Sequence

import pytest

from device_agent.protocol import AckStatus, Mode, ResetStop, State, StopDevice, topics
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import DeviceHarness, eventually, wait_for_state
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.device.test_device import grant


class HangingDriver(FakeDriver):
    """A driver that does not accept commands while ``answers`` is not set.

    Attributes:
        hanging: Set when the control loop waits for the driver.
    """

    def __init__(self) -> None:
        super().__init__()
        self.answers, self.hanging = threading.Event(), threading.Event()
        self.answers.set()
        self.ends_loop = False

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        if not self.answers.is_set():
            self.hanging.set()
            self.answers.wait()
            if self.ends_loop:
                raise SystemExit
        return super().send(position_rad)


@pytest.fixture
def hanging(make_device: MakeDevice) -> Iterator[DeviceHarness]:
    """A device whose control loop waits for its driver, with a lease of epoch 1."""
    driver = HangingDriver()
    harness = make_device(driver=driver)
    driver.answers.clear()
    assert driver.hanging.wait(10)
    yield harness
    driver.answers.set()


def driver_of(harness: DeviceHarness) -> HangingDriver:
    assert isinstance(harness.driver, HangingDriver)
    return harness.driver


def unconfirmed_stop(harness: DeviceHarness) -> str:
    """Send a Stop. The thread that processes it has finished with it, because it has processed the next command."""
    stop = harness.command(StopDevice())
    harness.done(grant(), epoch=1)
    assert [ack for ack in harness.acks(stop) if ack.status.terminal] == []
    return stop


def test_a_stop_is_confirmed_only_after_a_hanging_control_loop_has_applied_it(hanging: DeviceHarness) -> None:
    stop = unconfirmed_stop(hanging)
    state = wait_for_state(hanging, lambda state: state.stop)
    assert state.mode is not Mode.STOPPED
    driver_of(hanging).answers.set()
    assert hanging.end(stop).status is AckStatus.DONE
    wait_for_state(hanging, lambda state: state.mode is Mode.STOPPED)


def test_a_repeated_stop_needs_a_new_period_of_the_control_loop(make_device: MakeDevice) -> None:
    harness = make_device(driver=HangingDriver())
    harness.done(StopDevice())
    driver_of(harness).answers.clear()
    assert driver_of(harness).hanging.wait(10)
    unconfirmed_stop(harness)
    driver_of(harness).answers.set()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_stop_of_a_dead_control_loop_is_never_confirmed(hanging: DeviceHarness) -> None:
    driver_of(hanging).ends_loop = True
    driver_of(hanging).answers.set()
    eventually(lambda: not hanging.device._loop._thread.is_alive())
    unconfirmed_stop(hanging)


def test_a_stop_is_not_confirmed_during_a_fault_of_the_driver(harness: DeviceHarness) -> None:
    harness.driver.broken = True
    wait_for_state(harness, lambda state: state.mode is Mode.FAULT)
    stop = unconfirmed_stop(harness)
    harness.driver.broken = False
    assert harness.end(stop).status is AckStatus.DONE


def test_a_reset_ends_an_unconfirmed_stop_as_failed(hanging: DeviceHarness) -> None:
    stop = unconfirmed_stop(hanging)
    hanging.done(ResetStop(), epoch=2)
    assert hanging.end_code(stop) == "reset"
    driver_of(hanging).answers.set()
    assert all(state.mode is not Mode.STOPPED for state in hanging.published(topics.STATE, State))
