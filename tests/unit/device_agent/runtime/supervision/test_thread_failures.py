"""A device with a thread that has ended or hangs: it is halted, reports the fault, and confirms no Stop."""

import threading
from collections.abc import Iterator
from typing import Any
from unittest import mock

import pytest

from device_agent.ports.driver import DriverError
from device_agent.ports.threads import Recovery, SupervisedThread
from device_agent.protocol import AckStatus, Mode, MoveJoints, State, StopDevice, topics
from device_agent.protocol.events import EventKind
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.supervision import Supervisor
from tests.harness.agent.device_harness import DeviceHarness, eventually, wait_for_state
from tests.harness.agent.thread_crashes import InjectedCrash, crash
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.device.test_device import grant
from tests.unit.device_agent.runtime.supervision.test_stop_confirmation import HangingDriver

MOVE = MoveJoints(position_rad={"elbow": 2.5}, speed=0.1)


class Setup:
    """A supervised device that moves under lease 1."""

    def __init__(self, make_device: MakeDevice, driver: HangingDriver) -> None:
        self.supervisor = Supervisor()
        self.harness: DeviceHarness = make_device(driver=driver, supervisor=self.supervisor)
        self.driver = driver
        self.device: Any = self.harness.device
        self.harness.done(grant(), epoch=1)
        self.action = self.harness.running(MOVE, epoch=1)
        eventually(lambda: self.device._controller.moving)
        self.supervisor.check()
        self.reason = ""

    def state(self, code: str) -> State:
        """Supervise until a state with this fault is published."""
        self.supervise(lambda: any(fault.code == code for fault in self.newest().faults))
        return self.newest()

    def newest(self) -> State:
        newest: State = self.harness.published(topics.STATE, State)[-1]
        return newest

    def supervise(self, condition: Any) -> None:
        def check() -> Any:
            self.reason = self.reason or self.supervisor.check()
            return condition()

        eventually(check)

    def stop_unconfirmed(self) -> str:
        """Send a Stop, which is latched but not confirmed until the process would end."""
        stop = self.harness.command(StopDevice())
        self.harness.receive_stop()
        self.supervise(lambda: self.reason)
        assert [ack for ack in self.harness.acks(stop) if ack.status.terminal] == []
        return stop


@pytest.fixture
def setup(make_device: MakeDevice) -> Iterator[Setup]:
    driver = HangingDriver()
    yield Setup(make_device, driver)
    driver.answers.set()


def test_a_dead_control_loop_halts_the_driver_and_is_reported(setup: Setup) -> None:
    crash(setup.device._loop._thread)
    setup.supervisor.check()
    eventually(lambda: setup.driver.halted)
    state = setup.state("agent.control-loop")
    assert state.mode is Mode.FAULT
    assert [fault.code for fault in state.faults] == ["agent.control-loop"]
    assert "InjectedCrash" in state.faults[0].message
    (event,) = eventually(lambda: setup.harness.events(EventKind.PART_FAILED))
    assert event.data == {"part": "control loop"}
    assert setup.harness.end(setup.action).status is AckStatus.FAILED
    setup.stop_unconfirmed()


def test_a_stop_of_a_dead_control_loop_halts_the_driver_at_once(setup: Setup) -> None:
    crash(setup.device._loop._thread)
    assert not setup.driver.halted
    setup.harness.receive_stop()
    assert setup.driver.halted


def test_a_driver_that_cannot_be_halted_does_not_prevent_the_report(setup: Setup) -> None:
    setup.driver.answers.clear()
    with mock.patch.object(setup.driver, "halt", side_effect=DriverError("no answer")):
        assert setup.state("agent.control-loop").mode is Mode.FAULT
        setup.driver.answers.set()
        setup.supervise(lambda: setup.device._controller.fault is None)


def test_a_hanging_control_loop_is_halted_and_starts_at_rest_when_it_responds(setup: Setup) -> None:
    setup.driver.answers.clear()
    setup.supervise(lambda: setup.driver.halted)
    assert setup.state("agent.control-loop").mode is Mode.FAULT
    stop = setup.harness.command(StopDevice())
    eventually(lambda: setup.device._controller.latch)
    assert [ack for ack in setup.harness.acks(stop) if ack.status.terminal] == []
    position = setup.driver.position
    setup.driver.answers.set()
    setup.supervise(lambda: setup.harness.events(EventKind.PART_RECOVERED))
    assert setup.harness.end(stop).status is AckStatus.DONE
    assert setup.driver.position == position
    assert setup.reason == ""
    setup.supervise(lambda: setup.newest().faults == () and setup.newest().mode is Mode.STOPPED)


def test_a_loop_that_keeps_hanging_ends_the_process_without_a_confirmed_stop(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("device_agent.runtime.supervision.HANGING_S", 1.0)
    setup.driver.answers.clear()
    setup.stop_unconfirmed()
    assert "control loop does not respond" in setup.reason


def test_state_and_event_of_a_dead_command_processor_are_published_by_the_supervisor(setup: Setup) -> None:
    crash(setup.device._commands._thread)
    setup.state("agent.command-processor")
    eventually(lambda: setup.harness.events(EventKind.PART_FAILED))
    eventually(lambda: not setup.device._controller.moving)
    setup.stop_unconfirmed()


def test_the_event_of_a_hanging_command_processor_is_published_by_the_supervisor(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    thread = setup.device._commands._thread
    monkeypatch.setattr(thread, "_within_s", 0.2)
    with mock.patch.object(setup.device._commands, "_write_journal", released.wait):
        setup.supervise(lambda: setup.harness.events(EventKind.PART_FAILED))
        eventually(lambda: not setup.device._controller.moving)
        assert setup.newest().faults == ()
        released.set()
    setup.supervise(lambda: setup.harness.events(EventKind.PART_RECOVERED))


def test_a_dead_thread_of_the_whole_agent_holds_the_device_and_is_reported(setup: Setup) -> None:
    crash(setup.harness.outbox._thread)
    setup.state("agent.outbox")
    assert setup.harness.end(setup.action).status is AckStatus.FAILED
    assert setup.newest().lease is None
    setup.supervise(lambda: setup.harness.events(EventKind.PART_RECOVERED))
    wait_for_state(setup.harness, lambda state: state.faults == ())
    setup.harness.done(grant(), epoch=2)


def test_a_fault_of_the_driver_is_reported_beside_that_of_a_thread(setup: Setup) -> None:
    thread = setup.harness.outbox._thread
    thread.recovery = Recovery.EXIT
    crash(thread)
    setup.driver.broken = True
    setup.state("driver")
    assert {fault.code for fault in setup.newest().faults} == {"driver", "agent.outbox"}


def test_a_crashed_task_is_reported_once_and_its_fault_ends(setup: Setup) -> None:
    def fail() -> None:
        raise InjectedCrash

    task = SupervisedThread(fail, name="task", part="upload", device="arm")
    task.start()
    task.join(10)

    def shown() -> bool:  # In one state at least: the fault ends at once.
        states = setup.harness.published(topics.STATE, State)
        return any(fault.code == "agent.upload" for state in states for fault in state.faults)

    setup.supervise(shown)
    wait_for_state(setup.harness, lambda state: state.faults == ())
    assert len(setup.harness.events(EventKind.PART_FAILED)) == 1
    assert setup.harness.events(EventKind.PART_RECOVERED) == []


def test_an_action_whose_thread_crashes_is_failed(harness: DeviceHarness) -> None:
    def fail(*_: object, **__: object) -> None:
        raise InjectedCrash

    with mock.patch.object(RobotApi, "move_joints", fail):
        assert harness.failed(MOVE, epoch=1).code == "internal"
    harness.done(MoveJoints(position_rad={"elbow": 0.1}, speed=1.0), epoch=1)
