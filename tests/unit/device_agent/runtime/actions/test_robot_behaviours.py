"""Behaviours that the robot itself provides: hand-over of the joints, recoveries and the description."""

import threading
from collections.abc import Callable, Sequence

import pytest

from device_agent.ports.driver import DriverFault, UnreachableError
from device_agent.ports.skills import BehaviourContext, RobotBehaviour, SkillError
from device_agent.protocol import Description, GrantLease, Mode, MoveJoints, ResetStop, RunBehaviour, Task, topics
from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.runtime.actions.device_context import MAX_BEHAVIOURS
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.conftest import MakeDevice

WAVE = RunBehaviour(name="wave")
UNLOCK = RunBehaviour(name="unlock")
KIND = robot_type(behaviours={"bow": (Keyframe(time_s=0.3, position_rad={"shoulder": 0.1}),)})


class Robot(FakeDriver):
    """A robot that waves by itself: its elbow is at ``elbow`` until the test ends the wave."""

    behaviours: Sequence[RobotBehaviour] = (
        RobotBehaviour("wave", "animations/Wave"),
        RobotBehaviour("unlock", "Unlock", recovery=True),
        RobotBehaviour("bow", "the manifest's bow takes precedence"),
    )

    def __init__(self) -> None:
        super().__init__()
        self.elbow = 0.0
        self.runs = False
        self.error = ""
        self.present: tuple[DriverFault, ...] = ()
        self.sent: list[float] = []
        self.over, self.ended, self.rests = threading.Event(), threading.Event(), threading.Event()
        self.rests.set()

    def faults(self) -> tuple[DriverFault, ...]:
        return self.present

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        if self.runs:
            self.position = (self.position[0], self.elbow)
            return self.position
        self.sent.append(position_rad[1])
        return super().send(position_rad)

    def run_behaviour(self, name: str, context: BehaviourContext) -> None:
        if name not in {"wave", "unlock"}:
            raise SkillError(f"no behaviour '{name}'")
        self.runs = name == "wave"
        try:
            while not self.over.is_set() and not context.wait(0.01):
                pass
            if context.ended:
                self.ended.set()
            if self.error:
                raise SkillError(self.error)
            self.rests.wait(60)
        finally:
            self.runs = False


Start = Callable[..., tuple[DeviceHarness, Robot]]


@pytest.fixture
def start(make_device: MakeDevice) -> Start:
    def make(**parts: object) -> tuple[DeviceHarness, Robot]:
        robot = Robot()
        return make_device(**({"driver": robot, "kind": KIND} | parts)), robot

    return make


def wave(harness: DeviceHarness, robot: Robot) -> str:
    """Let the robot wave until the agent has noticed it."""
    running = harness.running(WAVE, epoch=1)
    robot.elbow = 1.2
    eventually(lambda: harness.telemetry().commanded_rad[1] == pytest.approx(1.2))
    return running


def stop_of_the_robot(*codes: str) -> tuple[DriverFault, ...]:
    return tuple(DriverFault(code, f"{code}; look at the arm") for code in codes)


def test_the_agent_adopts_the_positions_of_a_behaviour_without_a_jump(start: Start) -> None:
    harness, robot = start()
    harness.done(MoveJoints(position_rad={"elbow": 0.1}, speed=1.0), epoch=1)
    running = wave(harness, robot)
    before = len(robot.sent)
    assert harness.telemetry().mode is Mode.ACTION
    assert not [ack for ack in harness.acks(running) if ack.status.terminal], "the robot has not reported the end"
    robot.over.set()
    assert harness.end(running).reason is None
    eventually(lambda: len(robot.sent) > before + 5)
    assert robot.sent[before:] == pytest.approx([1.2] * len(robot.sent[before:]))
    harness.done(MoveJoints(position_rad={"elbow": 1.0}, speed=1.0), epoch=1)
    assert max(robot.sent[before:]) < 1.21


def test_setpoints_wait_until_the_robot_has_ended_its_motion(start: Start) -> None:
    harness, robot = start()
    robot.rests.clear()
    harness.done(GrantLease(holder="ann", lease_ms=30_000), epoch=1)
    running = wave(harness, robot)
    harness.device._executor.cancel(running, "ann")
    assert robot.ended.wait(60)
    eventually(lambda: harness.telemetry().mode is Mode.HOLDING)
    harness.setpoint(1, 1)
    assert harness.device.publisher.rejections == {"busy": 1}
    robot.rests.set()
    assert harness.end_code(running) == "cancelled"
    harness.setpoint(1, 2, elbow=1.1)
    eventually(lambda: robot.sent[-1] < 1.2 - 1e-6)
    assert harness.device.publisher.rejections == {"busy": 1}


def test_stop_ends_a_behaviour_and_is_confirmed_after_the_robot_rests(start: Start) -> None:
    harness, robot = start()
    robot.rests.clear()
    running = wave(harness, robot)
    harness.receive_stop()
    assert robot.ended.wait(60)
    number = harness.device._controller._state.stops
    after = harness.telemetry().sequence
    eventually(lambda: harness.telemetry().sequence > after + 5)
    assert not harness.device._controller.stop_applied(number)
    robot.rests.set()
    assert harness.end_code(running) == "stopped"
    eventually(lambda: harness.device._controller.stop_applied(number))
    assert harness.failed(WAVE, epoch=2).code == "stopped"


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_the_room_ends_and_prevents_a_behaviour_that_it_slows(start: Start, speed: float) -> None:
    harness, robot = start()
    running = wave(harness, robot)
    harness.device._controller.restrict("door", 1.0, "the door is closed")
    harness.device._controller.restrict("door", speed, "a person is near")
    assert harness.end_code(running) == "interlock"
    assert "a person is near" in harness.failed(WAVE, epoch=2).message
    assert robot.ended.is_set()


def test_a_failed_or_unknown_behaviour_fails_the_action(start: Start) -> None:
    harness, robot = start()
    assert harness.failed(RunBehaviour(name="fly"), epoch=1).message == "no behaviour 'fly'"
    robot.error = "the robot refused"
    robot.over.set()
    assert harness.failed(WAVE, epoch=1).message == "the robot refused"
    harness.done(RunBehaviour(name="bow"), epoch=1)


# ---------------------------------------------------------------- recoveries


def test_a_recovery_runs_while_stop_is_latched_and_while_the_reason_changes(start: Start) -> None:
    harness, robot = start()
    robot.present = stop_of_the_robot("protective-stop")
    eventually(lambda: harness.device._controller.latch)
    for task in (WAVE, MoveJoints(position_rad={"elbow": 0.1}, speed=1.0)):
        assert harness.failed(task, epoch=1).code == "stopped"
    running = harness.running(UNLOCK, epoch=1)
    robot.present = stop_of_the_robot("program-ended")
    eventually(lambda: "program-ended" in (harness.device._controller.fault or ""))
    robot.present = ()
    eventually(lambda: harness.device._controller.fault is None)
    assert not robot.ended.is_set()
    before = len(robot.sent)
    robot.over.set()
    assert harness.end(running).reason is None
    assert harness.device._controller.latch is not None, "only a reset releases it"
    assert set(robot.sent[before:]) <= {0.0}
    harness.done(ResetStop(), epoch=2)


def test_another_stop_and_a_lost_lease_end_a_recovery(start: Start) -> None:
    harness, _ = start()
    harness.receive_stop()
    eventually(lambda: harness.device._controller.latch)
    first = harness.running(UNLOCK, epoch=1)
    harness.receive_stop()
    assert harness.end_code(first) == "stopped"
    second = harness.running(UNLOCK, epoch=2)
    harness.done(GrantLease(holder="bob", lease_ms=30_000), epoch=3)
    assert harness.end_code(second) == "lease_lost"
    assert harness.failed(UNLOCK, epoch=2).code == "stale_epoch"


def test_a_recovery_cannot_move_joints_while_stop_is_latched(start: Start) -> None:
    harness, robot = start()
    harness.receive_stop()
    running = harness.running(UNLOCK, epoch=1)
    robot.elbow = 1.0
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)
    robot.over.set()
    harness.end(running)
    assert set(robot.sent) == {0.0}


# ---------------------------------------------------------------- description


def description(harness: DeviceHarness) -> Description:
    newest: Description = eventually(lambda: harness.published(topics.DESC, Description)[-1:])[0]
    return newest


def test_the_description_lists_the_robots_behaviours_and_follows_changes(start: Start) -> None:
    harness, robot = start()
    first = description(harness)
    assert first.behaviours == ("bow", "wave", "unlock")
    assert "run_behaviour" in first.actions
    assert [(each.name, each.label, each.recovery) for each in first.robot_behaviours] == [
        ("wave", "animations/Wave", False),
        ("unlock", "Unlock", True),
    ]
    robot.behaviours = tuple(RobotBehaviour(f"b{number}", f"B {number}") for number in range(200))
    eventually(lambda: len(description(harness).behaviours) == MAX_BEHAVIOURS)
    assert len(harness.published(topics.DESC, Description)) == 2


def test_a_robot_without_behaviours_of_its_own_lists_those_of_the_manifest(make_device: MakeDevice) -> None:
    harness = make_device(kind=KIND)
    assert description(harness).behaviours == ("bow",)
    task: Task = WAVE
    assert "there are bow" in harness.failed(task, epoch=1).message


def test_a_lost_robot_ends_its_behaviour(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    harness, robot = start()
    running = wave(harness, robot)

    def lost() -> None:
        raise UnreachableError("no answer")

    monkeypatch.setattr(robot, "observe", lost)
    assert harness.end_code(running) == "fault"
    assert robot.ended.is_set()
