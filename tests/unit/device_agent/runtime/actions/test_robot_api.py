"""Script calls and tasks, executed by a fake robot."""

import math
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from device_agent.ports import script_calls
from device_agent.protocol import (
    Express,
    LookAt,
    Measurements,
    RunBehaviour,
    Say,
    SetStiffness,
    TakePosture,
    codec,
    topics,
)
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze
from device_agent.runtime.readings import ReadingCache
from tests.fakes.drivers import robot_type
from tests.harness.agent.device_harness import DeviceHarness
from tests.unit.device_agent.runtime.actions.robot_api_fixture import (
    AbleDriver,
    Head,
    able_type,
    device_context,
    driver_of,
    play,
)


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


def test_a_script_reads_room_measurements() -> None:
    room = ReadingCache(space="s", agent="a", own=["arm"], named=[("b-pir", "presence")])
    body = replace(device_context(robot_type()), readings=room)
    robot = RobotApi(body)
    asked = script_calls.AskLatest(device="b-pir", stream="presence")
    assert robot.execute(asked) is None
    measured = Measurements(tick_ms=1, at_ms=1, sequence=1, values={"present": True, "distance_m": 1.5})
    room.receive(topics.parse("ts/v1/s/b/pir/tele/presence"), codec.encode(measured))
    answer = robot.execute(asked)
    assert answer["values"] == {"present": True, "distance_m": 1.5}
    assert 0 <= answer["age_s"] < 60


def test_state_needs_a_measurement() -> None:
    body = device_context(robot_type(), measured=False)
    assert body.measured() == {}
    with pytest.raises(Refused, match="not been measured"):
        body.observation()


def test_no_skill_runs_after_the_action_has_ended() -> None:
    able = AbleDriver()
    kind = msgspec.structs.replace(able_type(), gaze=None, capabilities=("gaze", "speech"))
    robot = RobotApi(device_context(kind, skills=able))
    robot.execute(LookAt(position_m=(1.0, 0.0, 0.0)))
    assert able.performed == [LookAt(position_m=(1.0, 0.0, 0.0))]
    robot.end()
    with pytest.raises(Refused, match="the action ended"):
        robot.skill_runner.perform(Say(text="x"))
    assert len(able.performed) == 1


def test_calls_without_model_or_skills_are_rejected() -> None:
    robot = RobotApi(device_context(robot_type()))
    with pytest.raises(Refused, match="no model"):
        robot._geometry()
    with pytest.raises(Refused, match="no skills"):
        robot.skill_runner.perform(Say(text="x"))
    with pytest.raises(Refused, match="no gaze"):
        gaze.solve_gaze(robot_type(), Head(), (0.0, 0.0), (1.0, 0.0, 0.0))


def test_releasing_without_a_reservation_is_harmless() -> None:
    robot = RobotApi(device_context(robot_type()))
    robot.reservation.on_revoked(Refused("x", "y"))
    robot.release()
    assert robot.ended.is_set()
