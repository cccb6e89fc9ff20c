"""Script calls and tasks, executed by a fake robot."""

import math
import time
from dataclasses import replace

import msgspec
import pytest

from device_agent.ports import script_calls
from device_agent.protocol import (
    BaseLimits,
    Description,
    Drive,
    Express,
    LookAt,
    Measurements,
    RunBehaviour,
    Say,
    SetStiffness,
    TakePosture,
    Task,
    codec,
    topics,
)
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import joint, robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.actions.robot_api_fixture import (
    CapableDriver,
    Head,
    capable_type,
    device_context,
    driver_of,
    play,
)
from tests.unit.device_agent.runtime.conftest import MakeDevice

SKILLS: tuple[Task, ...] = (
    Say(text="hello", language="en"),
    SetStiffness(value=0.4, joints=("elbow",)),
    Express(name="smile", strength=0.7),
    TakePosture(name="Sit", speed=0.9),
    RunBehaviour(name="nod"),
)


@pytest.mark.slow
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
    assert driver_of(harness).performed == list(SKILLS)
    assert max(twist.forward_m_s for twist in driver_of(harness).twists) > 0
    assert printed.startswith(f"{math.pi / 4:.2f} action (")
    assert all(call in printed for call in ("move_to", "look", "say", "drive", "behaviour"))


@pytest.mark.slow
def test_tasks_reach_the_same_skills_as_scripts(harness: DeviceHarness) -> None:
    for task in (*SKILLS, LookAt(position_m=(1.0, 1.0, 1.0), speed=1.0), Drive(forward_m_s=0.1, duration_s=0.05)):
        harness.done(task, epoch=1)
    assert driver_of(harness).performed == list(SKILLS)
    assert max(twist.forward_m_s for twist in driver_of(harness).twists) > 0
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[0]
    actions = "move_joints move_pose say express take_posture run_behaviour set_stiffness look_at drive"
    assert " ".join(described.actions) == actions
    assert described.base == BaseLimits(forward_m_s=0.5, left_m_s=0.0, turn_rad_s=1.0)
    assert (described.scripts, described.scripts_note) == ("sandboxed", "")


def test_a_straight_motion_reaches_the_pose_or_reports_why_not(harness: DeviceHarness) -> None:
    reached, failed = play(
        harness,
        "robot.move_to((0.1, 0, 0), rpy_rad=(0, 0, 0.6), speed=1, straight=True)\n"
        "print(round(robot.state()['position_rad']['shoulder'], 2))\n"
        "try: robot.move_to((2, 0, 0), straight=True)\n"
        "except RobotError as error: print(error)\n",
    ).splitlines()
    assert reached == "0.1"
    assert "of the way there: face cannot come nearer than 0.5 m" in failed


@pytest.mark.slow
def test_keyframes_are_played_in_time_and_delays_are_reported(harness: DeviceHarness) -> None:
    keyframes = "{'time_s': 0, 'position_rad': {'elbow': 0.1}}, {'time_s': %s, 'position_rad': {'elbow': 0.3}}"
    start_s = time.monotonic()
    play(harness, f"robot.play([{keyframes % 0.8}])")
    assert time.monotonic() - start_s >= 0.8
    assert harness.driver.position[1] == pytest.approx(0.3, abs=1e-3)
    ack = harness.done(harness.script(f"robot.play([{keyframes % 0.001}])"), epoch=1)
    assert ack.result["limited"] == ["keyframes: later"]


def test_unsupported_calls_are_rejected_with_the_supported_ones(make_device: MakeDevice) -> None:
    harness = make_device()
    calls = "say('x') express('x') behaviour('x') posture('x') stiffness(1) drive(1) look((1,0,0)) move_to((1,0,0))"
    tries = (f"try: robot.{call}\nexcept RobotError as error: print(error)\n" for call in calls.split())
    assert play(harness, "".join(tries)).splitlines() == [
        f"this robot has no {call.split('(')[0]}; it has move_joints, play, home, state, latest"
        for call in calls.split()
    ]
    assert "this robot has no say" in harness.failed(Say(text="hello"), epoch=1).message


@pytest.mark.parametrize(
    ("call", "expected"),
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
        ("robot.move_joints({'elbow': 1.5}, plan=True)", "found no path there"),
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
def test_failed_calls_report_reason_and_line(harness: DeviceHarness, call: str, expected: str) -> None:
    message = harness.failed(harness.script(f"\n{call}"), epoch=1).message
    assert message.startswith("line 2: ")
    assert expected in message


def test_a_script_reads_room_measurements() -> None:
    readings = ReadingCache(space="s", agent="a", own=["arm"], named=[("b-pir", "presence")])
    robot = RobotApi(replace(device_context(robot_type()), readings=readings))
    call = script_calls.GetLatest(device="b-pir", stream="presence")
    assert robot.execute(call) is None
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True, "distance_m": 1.5})
    readings.receive(topics.parse("ts/v1/s/b/pir/tele/presence"), codec.encode(measured))
    reading = robot.execute(call)
    assert reading["values"] == {"present": True, "distance_m": 1.5}
    assert 0 <= reading["age_s"] < 60


def test_no_skill_runs_after_the_action_has_ended() -> None:
    driver = CapableDriver()
    kind = msgspec.structs.replace(capable_type(), gaze=None, capabilities=("gaze", "speech"))
    robot = RobotApi(device_context(kind, skills=driver))
    robot.execute(LookAt(position_m=(1.0, 0.0, 0.0)))
    robot.end()
    with pytest.raises(Refused, match="the action ended"):
        robot.skill_runner.perform(Say(text="x"))
    assert driver.performed == [LookAt(position_m=(1.0, 0.0, 0.0))]


def test_calls_without_model_skills_measurement_or_reservation() -> None:
    context = device_context(robot_type(), measured=False)
    assert context.measured() == {}
    with pytest.raises(Refused, match="not been measured"):
        context.observation()
    robot = RobotApi(context)
    with pytest.raises(Refused, match="no model"):
        robot._geometry()
    with pytest.raises(Refused, match="no skills"):
        robot.skill_runner.perform(Say(text="x"))
    with pytest.raises(Refused, match="no gaze"):
        gaze.solve_gaze(robot_type(), Head(), (0.0, 0.0), (1.0, 0.0, 0.0))
    robot.reservation.on_revoked(Refused("x", "y"))
    robot.release()
    assert robot.ended.is_set()


@pytest.mark.parametrize("point", [(1.0, 1.0, 1.0), (2.0, -1.0, 0.2), (0.3, 0.1, 1.8), (-0.5, 0.8, 1.0)])
def test_gaze_reaches_the_point(point: tuple[float, float, float]) -> None:
    target = gaze.solve_gaze(capable_type(), Head(), (0.1, -0.1), point)
    left, up = math.atan2(point[1], point[0]), math.atan2(point[2] - 1, math.hypot(point[0], point[1]))
    assert target == pytest.approx({"shoulder": left, "elbow": up}, abs=5e-3)


def test_gaze_out_of_reach_is_rejected() -> None:
    narrow = tuple(joint(name, lower_rad=-0.2, upper_rad=0.2) for name in ("shoulder", "elbow"))
    with pytest.raises(Refused, match="shoulder, elbow cannot turn far enough"):
        gaze.solve_gaze(msgspec.structs.replace(capable_type(), joints=narrow), Head(), (0.0, 0.0), (0.0, 1.0, 1.0))


# ---------------------------------------------------------------- expressions and postures of the manifest


def posing_type() -> RobotType:
    return robot_type(
        home_rad={"shoulder": 0.0, "elbow": 0.1},
        expressions={"glad": {"elbow": 0.3}, "shy": {"shoulder": -0.2}},
        postures={"Bow": {"elbow": 0.25}},
    )


@pytest.mark.slow
def test_expressions_and_postures_of_the_manifest_need_no_driver(make_device: MakeDevice) -> None:
    harness = make_device(kind=posing_type())
    for task, position_rad in (
        (Express(name="glad"), (0.0, 0.3)),
        (Express(name="glad", strength=0.5), (0.0, 0.2)),
        (Express(name="shy", strength=0.25), (-0.05, 0.1)),
        (TakePosture(name="Bow", speed=1.0), (-0.05, 0.25)),
    ):
        harness.done(task, epoch=1)
        assert harness.driver.position == pytest.approx(position_rad, abs=2e-4), task


def test_unknown_expressions_and_postures_are_rejected_with_the_known_ones(make_device: MakeDevice) -> None:
    harness = make_device(kind=posing_type())
    for task, expected in (
        (Express(name="sad"), "no expression 'sad'; there are glad, shy"),
        (TakePosture(name="Sit"), "no posture 'Sit'; there are Bow"),
        (RunBehaviour(name="dance"), "this robot has no behaviour; it has move_joints, express, posture, play, home, "),
    ):
        assert expected in harness.failed(task, epoch=1).message
