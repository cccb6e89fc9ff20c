"""Every call of the script API, from the sandboxed script to a fake robot."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import pytest

from device_agent.ports import script_calls
from device_agent.ports.driver import Observation, Twist
from device_agent.ports.geometry import Clearance, GeometryError, Sweep, never
from device_agent.ports.skills import Skill, SkillError, Stage
from device_agent.protocol import (
    AckStatus,
    BaseLimits,
    CancelAction,
    Description,
    Drive,
    Event,
    Express,
    LookAt,
    Measurements,
    MoveJoints,
    Pose,
    RunBehaviour,
    Say,
    SetStiffness,
    Stop,
    TakePosture,
    Task,
    codec,
    topics,
)
from device_agent.protocol.manifests.robot_type import Base, Gaze, RobotType
from device_agent.runtime.actions.device_context import DeviceContext
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import FakeDriver, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.agent.sandbox import LACK, NoSandbox


class AbleDriver(FakeDriver):
    """A driver that executes and records every skill at once."""

    performs = ("speech", "stiffness", "gaze", "expressions", "behaviours", "postures")

    def __init__(self) -> None:
        super().__init__()
        self.performed: list[Skill] = []
        self.twists: list[Twist] = []
        self.interrupted = threading.Event()

    def drive(self, twist: Twist) -> Twist:
        self.twists.append(twist)
        return twist

    def perform(self, skill: Skill, stage: Stage) -> None:
        self.performed.append(skill)
        match skill:
            case RunBehaviour(name="nod"):
                stage.move_joints({"elbow": 0.1}, 1.0)
            case RunBehaviour(name="too_far"):
                stage.move_joints({"elbow": 99.0}, 1.0)
            case RunBehaviour(name="dance"):
                while not stage.ended:
                    stage.wait(0.01)
                self.interrupted.set()
            case RunBehaviour(name="sulk"):
                stage.wait(60)
                raise SkillError("it broke off")
            case Express(name="frown"):
                raise SkillError("no expression 'frown'; there are smile")


class Head:
    """A geometry: the shoulder turns it left, the elbow turns it up; it looks along its x axis, from 1 m above."""

    frames = ("face",)

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        yaw, pitch = position_rad[0] / 2, -position_rad[1] / 2
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        return {"face": (0.0, 0.0, 1.0, cy * cp, -sy * sp, cy * sp, sy * cp)}

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        del position_rad
        return Clearance(10.0, ("face", "floor"))

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        del path_rad
        return Sweep(1.0)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        raise NotImplementedError

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        return max(map(abs, velocity_rad_s))

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        del frame, start_rad
        if pose[0] > 1:
            raise GeometryError("face cannot come nearer than 0.5 m")
        return (pose[0], pose[6])

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        raise NotImplementedError

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int = 0,
        within_s: float = 5.0,
        ended: Callable[[], bool] = never,
    ) -> tuple[tuple[float, ...], ...]:
        del seed, within_s, ended
        if goal_rad[1] > 1:
            raise GeometryError("found no way there")
        return (tuple(start_rad), (0.0, 0.2), tuple(goal_rad))


def able_type() -> RobotType:
    base = Base(
        max_linear_m_s=0.5,
        max_angular_rad_s=1.0,
        max_linear_acceleration_m_s2=5.0,
        max_angular_acceleration_rad_s2=5.0,
        braking_linear_m_s2=5.0,
        braking_angular_rad_s2=5.0,
    )
    return msgspec.structs.replace(
        robot_type(),
        capabilities=("cartesian", "speech", "stiffness", "expressions", "behaviours", "postures"),
        frames=("face",),
        model="toy.xml",
        base=base,
        gaze=Gaze(frame="face", joints=("shoulder", "elbow")),
    )


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    harness = DeviceHarness(tmp_path, driver=AbleDriver(), kind=able_type(), geometry=Head())
    harness.start()
    yield harness
    harness.stop()


def driver_of(harness: DeviceHarness) -> AbleDriver:
    assert isinstance(harness.driver, AbleDriver)
    return harness.driver


def play(harness: DeviceHarness, source: str) -> str:
    """What it printed; it must end well."""
    ack = harness.end(harness.command(harness.script(source), epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    return ack.output


def test_every_call_reaches_a_fully_capable_robot(harness: DeviceHarness) -> None:
    printed = play(
        harness,
        "robot.say('hello', language='en')\n"
        "robot.stiffness(0.4, ['elbow'])\n"
        "robot.express('smile', 0.7)\n"
        "robot.posture('Sit', 0.9)\n"
        "robot.behaviour('nod')\n"
        "robot.drive(0.1, turn_rad_s=0.2, duration_s=0.05)\n"
        "robot.home(1)\n"
        "robot.move_joints({'elbow': 0.2}, speed=1)\n"
        "robot.move_to((0.1, 0, 0), rpy_rad=(0, 0, 0.6), speed=1)\n"
        "robot.move_joints({'elbow': 0.1}, speed=1, plan=True)\n"
        "robot.look((1, 1, 1), speed=1)\n"
        "state = robot.state()\n"
        "print(round(state['position_rad']['shoulder'], 2), state['mode'], robot.can)\n",
    )
    assert driver_of(harness).performed == [
        Say(text="hello", language="en"),
        SetStiffness(value=0.4, joints=("elbow",)),
        Express(name="smile", strength=0.7),
        TakePosture(name="Sit", speed=0.9),
        RunBehaviour(name="nod"),
    ]
    assert max(twist.forward_m_s for twist in driver_of(harness).twists) > 0
    assert printed.startswith(f"{math.pi / 4:.2f} action (")
    assert all(call in printed for call in ("move_to", "look", "say", "drive", "behaviour"))


def test_a_straight_motion_reaches_the_pose_or_reports_why_not(harness: DeviceHarness) -> None:
    printed = play(
        harness,
        "robot.move_to((0.1, 0, 0), rpy_rad=(0, 0, 0.6), speed=1, straight=True)\n"
        "print(round(robot.state()['position_rad']['shoulder'], 2))\n"
        "try: robot.move_to((2, 0, 0), straight=True)\n"
        "except RobotError as error: print(error)\n",
    ).splitlines()
    assert printed[0] == "0.1"
    assert "of the way there: face cannot come nearer than 0.5 m" in printed[1]


def test_keyframes_are_played_in_time_and_delays_are_reported(harness: DeviceHarness) -> None:
    keyframes = "{'time_s': 0, 'position_rad': {'elbow': 0.1}}, {'time_s': %s, 'position_rad': {'elbow': 0.3}}"
    start_s = time.monotonic()
    play(harness, f"robot.play([{keyframes % 0.8}])")
    assert time.monotonic() - start_s >= 0.8
    assert harness.driver.position[1] == pytest.approx(0.3, abs=1e-3)
    ack = harness.end(harness.command(harness.script(f"robot.play([{keyframes % 0.001}])"), epoch=1))
    assert ack.result["limited"] == ["keyframes: later"]


def test_unsupported_calls_are_rejected_with_the_supported_ones(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.device.start()
    asked = (
        "robot.say('x')",
        "robot.express('x')",
        "robot.behaviour('x')",
        "robot.posture('x')",
        "robot.stiffness(1)",
        "robot.drive(1)",
        "robot.look((1, 0, 0))",
        "robot.move_to((1, 0, 0))",
    )
    lines = "".join(f"try: {call}\nexcept RobotError as error: print(error)\n" for call in asked)
    printed = play(harness, lines).splitlines()
    assert [line.split(";")[0] for line in printed] == [
        f"this robot has no {call.removeprefix('robot.').split('(')[0]}" for call in asked
    ]
    assert all(line.endswith("it has move_joints, play, home, state, latest") for line in printed)
    harness.stop()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        ("robot.express('frown')", "no expression 'frown'; there are smile"),
        ("robot.express('smile', 2)", "Expected `float` <= 1.0 - at `$.strength`"),
        ("robot.stiffness(-1)", "Expected `float` >= 0.0 - at `$.value`"),
        ("robot.behaviour('too_far')", "elbow can go from"),
        ("robot.home(speed=0)", "Expected `float` > 0.0 - at `$.speed`"),
        ("robot.move_to((0, 0, 0), frame='foot')", "no frame 'foot'; there are face"),
        ("robot.move_to((2, 0, 0))", "face cannot come nearer than 0.5 m"),
        ("robot.move_to((0, 0, 0), quaternion=(0, 0, 0, 0))", "has no direction"),
        ("robot.move_to((0, 0, 0), straight=True, plan=True)", "straight or planned, not both"),
        ("robot.move_joints({'elbow': 1.5}, plan=True)", "found no way there"),
        ("robot.move_joints({'elbow': 99}, plan=True)", "elbow can go from"),
        ("robot.look((0, 0, 1))", "inside the frame that looks"),
        ("robot.look((-1, -0.1, 0.9), speed=9)", "Expected `float` <= 1.0 - at `$.speed`"),
        ("robot.drive(99)", "forward_m_s can be up to 0.500"),
        ("room.latest('x', 'y')", "is not subscribed"),
        ("robot.play([{'time_s': 0}, {'time_s': 1, 'position_rad': {'elbow': 9}}])", "keyframe 2: elbow can go from"),
        ("robot.play([{'time_s': 0}, {'time_s': 1, 'position_rad': {'nose': 9}}])", "keyframe 2: no joint 'nose'"),
        ("robot.play([{'time_s': float('nan')}, {'time_s': 1}])", "the time of keyframe 1 is not a finite number"),
        ("robot.play([{'time_s': 0}, {'time_s': 1}], speed=3)", "speed must be above 0 and at most 2, not 3.0"),
    ],
)
def test_failed_calls_report_reason_and_line(harness: DeviceHarness, call: str, says: str) -> None:
    ack = harness.end(harness.command(harness.script(f"\n{call}"), epoch=1))
    assert ack.reason is not None
    assert ack.reason.message.startswith("line 2: RobotError: ")
    assert says in ack.reason.message


def test_stop_ends_a_skill_and_the_script(harness: DeviceHarness) -> None:
    running = harness.command(harness.script("robot.behaviour('dance')\nrobot.say('still here')"), epoch=1)
    eventually(lambda: driver_of(harness).performed)
    harness.receive(topics.STOP, msgspec.json.encode(Stop(id="s1", caller="bob", reason="smoke")))
    assert harness.end_code(running) == "stopped"
    assert driver_of(harness).interrupted.wait(10)
    assert driver_of(harness).performed == [RunBehaviour(name="dance")]


@pytest.mark.parametrize("name", ["dance", "sulk"])
def test_a_cancel_ends_a_skill(harness: DeviceHarness, name: str) -> None:
    running = harness.command(harness.script(f"robot.behaviour('{name}')"), epoch=1)
    eventually(lambda: driver_of(harness).performed)
    harness.command(CancelAction(action=running))
    assert harness.end(running).status is AckStatus.CANCELLED


def test_a_script_times_out(harness: DeviceHarness) -> None:
    order = msgspec.structs.replace(harness.script("print('started')\nwait(600)"), timeout_ms=300)
    ack = harness.end(harness.command(order, epoch=1))
    assert ack.reason is not None
    assert (ack.status, ack.reason.code) == (AckStatus.FAILED, "too_long")
    assert "after its 0.3 s" in ack.reason.message


def test_progress_and_output_are_acknowledged_while_it_runs(harness: DeviceHarness) -> None:
    source = "for i in range(4):\n    progress(i / 4)\n    print('part', i)\n    wait(0.25)\n"
    running = harness.command(harness.script(source), epoch=1)
    harness.end(running)
    told = [ack for ack in harness.acks(running) if ack.status is AckStatus.STARTED]
    assert len({ack.progress for ack in told}) > 2
    assert any("part 0" in ack.output and "part 3" not in ack.output for ack in told)


def test_an_older_version_does_not_run_again(harness: DeviceHarness) -> None:
    assert harness.end(harness.command(harness.script("print(2)", version=2), epoch=1)).status is AckStatus.DONE
    assert harness.end_code(harness.command(harness.script("print(1)", version=1), epoch=1)) == "rolled_back"


def test_a_script_of_another_account_runs_behind_bubblewrap(harness: DeviceHarness) -> None:
    source = "import os\nprint(os.getpid())"
    own = int(harness.end(harness.command(harness.script(source), epoch=1)).output)
    strange = int(harness.end(harness.command(harness.script(source, author="accountbbbbbbbbb"), epoch=1)).output)
    parents = [
        int(process) for task in Path("/proc/self/task").glob("*/children") for process in task.read_text().split()
    ]
    # The machine's numbers come round again, so they say nothing about each other.
    assert strange < min(own, *parents), "it does not see process ids of its own"


def test_a_result_contains_the_limits(harness: DeviceHarness) -> None:
    harness.device._controller.restrict("room", 0.2, "a person is near")
    ack = harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.05}, speed=1.0), epoch=1))
    assert ack.status is AckStatus.DONE
    assert ack.result["limited"] == ["interlock: a person is near"]


@pytest.mark.parametrize("how", ["unavailable", "unconfined"])
def test_a_missing_sandbox_is_described_and_scripts_are_rejected(
    tmp_path: Path, how: Literal["unavailable", "unconfined"]
) -> None:
    harness = DeviceHarness(tmp_path, sandbox=NoSandbox(how))
    harness.start()
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert (described.scripts, described.scripts_note) == (how, LACK)
    eventually(lambda: [event for event in harness.heard(topics.EVENT, Event) if event.kind == f"scripts-{how}"])
    reason = harness.end(harness.command(harness.script("print(1)"), epoch=1)).reason
    assert reason is not None
    assert (reason.code, reason.message) == ("no_sandbox", LACK)
    harness.stop()


def test_desc_reports_the_sandbox(harness: DeviceHarness) -> None:
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert (described.scripts, described.scripts_note) == ("sandboxed", "")


def test_a_script_reads_room_measurements() -> None:
    room = ReadingCache(space="s", agent="a", own=["arm"], named=[("b-pir", "presence")])
    body = replace(body_of(robot_type()), readings=room)
    robot = RobotApi(body)
    asked = script_calls.AskLatest(device="b-pir", stream="presence")
    assert robot.execute(asked) is None
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True, "distance_m": 1.5})
    room.receive(topics.parse("ts/v1/s/b/pir/tele/presence"), codec.encode(measured))
    answer = robot.execute(asked)
    assert answer["values"] == {"present": True, "distance_m": 1.5}
    assert 0 <= answer["age_s"] < 60


# ---------------------------------------------------------------- without a device around it


def body_of(
    kind: RobotType, *, seen: bool = True, able: AbleDriver | None = None, head: Head | None = None
) -> DeviceContext:
    observation = Observation((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ())
    controller = Controller(kind, LeaseGate())
    controller.start_at((0.0, 0.0))
    return DeviceContext(
        robot_type=kind,
        controller=controller,
        observe=lambda: observation if seen else None,
        geometry=head,
        skills=able,
        readings=ReadingCache(space="s", agent="a", own=["arm"]),
    )


def test_state_needs_a_measurement() -> None:
    body = body_of(robot_type(), seen=False)
    assert body.measured() == {}
    with pytest.raises(Refused, match="not been measured"):
        body.observation()


def test_no_skill_runs_after_the_action_has_ended() -> None:
    able = AbleDriver()
    kind = msgspec.structs.replace(able_type(), gaze=None, capabilities=("gaze", "speech"))
    robot = RobotApi(body_of(kind, able=able))
    robot.execute(LookAt(position_m=(1.0, 0.0, 0.0)))
    assert able.performed == [LookAt(position_m=(1.0, 0.0, 0.0))]
    robot.end()
    with pytest.raises(Refused, match="the action ended"):
        robot.skill_runner.perform(Say(text="x"))
    assert len(able.performed) == 1


def test_calls_without_model_or_skills_are_rejected() -> None:
    robot = RobotApi(body_of(robot_type()))
    with pytest.raises(Refused, match="no model"):
        robot._geometry()
    with pytest.raises(Refused, match="no skills"):
        robot.skill_runner.perform(Say(text="x"))
    with pytest.raises(Refused, match="no gaze"):
        gaze.solve_gaze(robot_type(), Head(), (0.0, 0.0), (1.0, 0.0, 0.0))


@pytest.mark.parametrize("point", [(1.0, 1.0, 1.0), (2.0, -1.0, 0.2), (0.3, 0.1, 1.8), (-0.5, 0.8, 1.0)])
def test_gaze_reaches_the_point(point: tuple[float, float, float]) -> None:
    found = gaze.solve_gaze(able_type(), Head(), (0.1, -0.1), point)
    left, up = math.atan2(point[1], point[0]), math.atan2(point[2] - 1, math.hypot(point[0], point[1]))
    assert found["shoulder"] == pytest.approx(left, abs=5e-3)
    assert found["elbow"] == pytest.approx(up, abs=5e-3)


def test_gaze_out_of_reach_is_rejected() -> None:
    kind = able_type()
    narrow = tuple(msgspec.structs.replace(joint, lower_rad=-0.2, upper_rad=0.2) for joint in kind.joints)
    with pytest.raises(Refused, match="shoulder, elbow cannot turn far enough"):
        gaze.solve_gaze(msgspec.structs.replace(kind, joints=narrow), Head(), (0.0, 0.0), (0.0, 1.0, 1.0))


def test_releasing_without_a_reservation_is_harmless() -> None:
    robot = RobotApi(body_of(robot_type()))
    robot.reservation.on_revoked(Refused("x", "y"))
    robot.release()
    assert robot.ended.is_set()


def showing_type() -> RobotType:
    return msgspec.structs.replace(
        robot_type(),
        home_rad={"shoulder": 0.0, "elbow": 0.1},
        expressions={"glad": {"elbow": 0.3}, "shy": {"shoulder": -0.2}},
        postures={"Bow": {"elbow": 0.25}},
    )


@pytest.mark.parametrize(
    ("request_", "there"),
    [
        (Express(name="glad"), {"shoulder": 0.0, "elbow": 0.3}),
        (Express(name="glad", strength=0.5), {"shoulder": 0.0, "elbow": 0.2}),
        (Express(name="shy", strength=0.25), {"shoulder": -0.05, "elbow": 0.1}),
        (TakePosture(name="Bow", speed=1.0), {"shoulder": 0.0, "elbow": 0.25}),
    ],
)
def test_expressions_and_postures_of_the_manifest_need_no_driver(
    tmp_path: Path, request_: Express | TakePosture, there: dict[str, float]
) -> None:
    harness = DeviceHarness(tmp_path, kind=showing_type())
    harness.device.start()
    ack = harness.end(harness.command(request_, epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    assert harness.driver.position == pytest.approx([there["shoulder"], there["elbow"]], abs=2e-4)
    harness.stop()


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (Express(name="sad"), "no expression 'sad'; there are glad, shy"),
        (TakePosture(name="Sit"), "no posture 'Sit'; there are Bow"),
        (
            RunBehaviour(name="dance"),
            "this robot has no behaviour; it has move_joints, play, home, express, posture, state",
        ),
        (SetStiffness(value=0.0), "this robot has no stiffness"),
        (LookAt(position_m=(1.0, 0.0, 0.0)), "this robot has no look"),
        (Drive(forward_m_s=0.1), "this robot has no drive"),
        (Say(text="hello"), "this robot has no say"),
    ],
)
def test_an_unsupported_task_fails_with_the_supported_ones(tmp_path: Path, request_: Task, says: str) -> None:
    harness = DeviceHarness(tmp_path, kind=showing_type())
    harness.device.start()
    reason = harness.end(harness.command(request_, epoch=1)).reason
    assert reason is not None
    assert says in reason.message
    harness.stop()


def test_tasks_reach_the_same_skills_as_scripts(harness: DeviceHarness) -> None:
    orders: tuple[Task, ...] = (
        Say(text="ahoj", language="sk"),
        SetStiffness(value=0.5, joints=("elbow",)),
        Express(name="smile", strength=0.7),
        TakePosture(name="Sit"),
        RunBehaviour(name="nod"),
        LookAt(position_m=(1.0, 1.0, 1.0), speed=1.0),
        Drive(forward_m_s=0.1, duration_s=0.05),
    )
    for order in orders:
        ack = harness.end(harness.command(order, epoch=1))
        assert ack.status is AckStatus.DONE, ack.reason
    assert driver_of(harness).performed == list(orders[:5])
    assert max(twist.forward_m_s for twist in driver_of(harness).twists) > 0
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert described.actions == (
        "move_joints",
        "move_pose",
        "say",
        "express",
        "take_posture",
        "run_behaviour",
        "set_stiffness",
        "look_at",
        "drive",
    )
    assert described.base == BaseLimits(forward_m_s=0.5, left_m_s=0.0, turn_rad_s=1.0)
