"""Scripts in the sandboxed process: calls, keyframes, errors and imports."""

import re

import pytest

from device_agent import protocol
from device_agent.ports import script_calls
from device_agent.runtime.actions.script_action import ScriptFailed
from tests.unit.device_agent.runtime.actions.script_action_fixture import run


def test_a_script_moves_prints_and_reads_its_parameters() -> None:
    api, output = run(
        "for angle in parameters['angles']:\n"
        "    robot.move_joints({'elbow': angle}, speed=0.3)\n"
        "robot.move_joints([1, 2])\n"
        "robot.home()\n"
        "wait(0.01)\n"
        "progress(0.5)\n"
        "print('elbow', robot.state()['position_rad']['elbow'], robot.joints, robot.frames, robot.can[0])\n",
        {"angles": [0.5, 1]},
    )
    assert api.received == [
        ({"elbow": 0.5}, 0.3),
        ({"elbow": 1.0}, 0.3),
        ({"shoulder": 1.0, "elbow": 2.0}, 0.5),
        script_calls.Home(speed=0.5),
    ]
    assert output.printed == "elbow 0.2 ('shoulder', 'elbow') ('tool',) move_joints\n"
    assert output.progress == [0.5]


def test_every_call_of_the_api_is_received_unchanged() -> None:
    api, _ = run(
        "robot.move_to([0.1, 0, 0.3], rpy_rad=(0, 0, 1), speed=0.2)\n"
        "robot.move_to((0.1, 0, 0.3), quaternion=(1, 0, 0, 0), frame='camera')\n"
        "robot.drive(0.1, turn_rad_s=0.5, duration_s=2)\n"
        "robot.look((1, 0, 0))\n"
        "robot.say('ahoj', language='sk')\n"
        "robot.stiffness(0.5, ['elbow'])\n"
        "robot.express('smile', 0.7)\n"
        "robot.behaviour('wave')\n"
        "room.latest('agent-pir', 'presence')\n"
    )
    assert api.received == [
        protocol.MovePose(frame="tool", position_m=(0.1, 0, 0.3), rpy_rad=(0, 0, 1), speed=0.2),
        protocol.MovePose(frame="camera", position_m=(0.1, 0, 0.3), quaternion=(1, 0, 0, 0), speed=0.5),
        protocol.Drive(forward_m_s=0.1, left_m_s=0, turn_rad_s=0.5, duration_s=2),
        protocol.LookAt(position_m=(1, 0, 0), speed=0.5),
        protocol.Say(text="ahoj", language="sk"),
        protocol.SetStiffness(value=0.5, joints=("elbow",)),
        protocol.Express(name="smile", strength=0.7),
        protocol.RunBehaviour(name="wave"),
        script_calls.GetLatest(device="agent-pir", stream="presence"),
    ]


def test_play_is_split_at_keyframes_with_other_calls() -> None:
    api, _ = run(
        "robot.play([\n"
        "    {'time_s': 1, 'position_rad': {'elbow': 0.1}, 'say': 'off'},\n"
        "    {'time_s': 2, 'position_rad': {'elbow': 0.2}},\n"
        "    {'time_s': 3, 'express': 'smile', 'posture': 'Sit', 'drive': {'forward_m_s': 0.1, 'duration_s': 2}},\n"
        "    {'time_s': 5},\n"
        "    {'time_s': 5.5, 'position_rad': {'shoulder': 0.3}, 'go_to': {'x_m': 1, 'y_m': 2}, 'behaviour': 'nod'},\n"
        "], speed=0.5)\n"
        "robot.play([{'time_s': 0, 'say': 'end'}])\n"
        "robot.play([])\n"
    )
    keyframe = script_calls.PlayKeyframe(time_s=1, position_rad={"elbow": 0.2})
    assert api.received == [
        ({"elbow": 0.1}, 0.25),
        protocol.Say(text="off", language=""),
        script_calls.Play(keyframes=(keyframe, script_calls.PlayKeyframe(time_s=2)), first=2, speed=0.5),
        protocol.TakePosture(name="Sit", speed=0.5),
        protocol.Express(name="smile", strength=1),
        protocol.Drive(forward_m_s=0.1, left_m_s=0, turn_rad_s=0, duration_s=2),
        script_calls.Play(
            keyframes=(
                script_calls.PlayKeyframe(time_s=2),
                script_calls.PlayKeyframe(time_s=2.5, position_rad={"shoulder": 0.3}),
            ),
            first=4,
            speed=0.5,
        ),
        protocol.RunBehaviour(name="nod"),
        protocol.GoTo(x_m=1, y_m=2),
        protocol.Say(text="end", language=""),
    ]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("x = 1\ny = x / 0\n", "line 2: ZeroDivisionError"),
        ("def f():\n    raise ValueError('no')\n\n\nf()\n", "line 2: ValueError: no"),
        ("robot.move_joints({'elbow': float('nan')})", "line 1: ValueError"),
        ("robot.move_joints({'elbow': 10**400})", "line 1: OverflowError"),
        ("robot.move_joints([1])", "line 1: 1 positions for 2 joints"),
        ("robot.move_joints({})", "line 1: not a valid"),
        ("\nrobot.move_joints({'knee': 1})", "line 2: no joint 'knee'"),
        ("robot.move_to([1, 2])", "line 1: position_m needs 3 numbers, not 2"),
        ("robot.move_to([1, 2, 3], quaternion=[1, 0, 0, 0], rpy_rad=[0, 0, 0])", "line 1: give a"),
        ("robot.move_joints()", "line 1: TypeError: robot.move_joints() missing 1 required positional argument"),
        ("robot.move_joints({}, fast=1)", "line 1: TypeError: robot.move_joints() got an unexpected keyword"),
        ("room.fly()", "line 1: AttributeError: room has no attribute 'fly'"),
        ("\n\nrobot.fly()", "line 3: AttributeError: there is no robot.fly; there are behaviour, drive"),
        ("if True print", "line 1: SyntaxError"),
        ("raise SystemExit(3)", "line 1: SystemExit: 3"),
        ("import asyncio", "line 1: ModuleNotFoundError: a script cannot import 'asyncio'; it can import abc"),
        ("x = bytearray(2**30)", "line 1: MemoryError"),
        ("import os\nos._exit(1)", "ended before the script did"),
        ("import os\nos._exit(7)", "ended before the script did: it ended with 7"),
        ("import ctypes\nctypes.string_at(0)", "ended before the script did: it crashed"),
        ("import ctypes\nctypes.CDLL(None).ptrace(0, 0, 0, 0)", "did: it made a forbidden system call"),
    ],
)
def test_a_failed_script_reports_the_line(source: str, message: str) -> None:
    with pytest.raises(ScriptFailed) as failed:
        run(source)
    assert message in str(failed.value)
    assert not re.search(r"\b(RobotError|Robot|Room)\b", str(failed.value)), "a class of the product"


def test_a_script_can_catch_rejections() -> None:
    _, output = run("try:\n    robot.move_joints({'knee': 1})\nexcept RobotError as e:\n    print(e)\n")
    assert output.printed == "no joint 'knee'\n"


@pytest.mark.parametrize(
    "source",
    [
        "import numpy as np; print(round(float(np.linalg.det(np.linalg.inv(np.diag([2.0, 4.0])))), 6))",
        "import datetime as d; print(d.datetime.strptime('2026', '%Y').year)",
        "import statistics, itertools, dataclasses, re, heapq, decimal; print(decimal.Decimal('0.1'))",
        "import random, secrets, uuid, hashlib; print(len(uuid.uuid4().hex))",
        "import time; print(time.localtime().tm_year > 2000, 'é'.encode('cp1252'))",
    ],
)
def test_common_imports_work_in_scripts(source: str) -> None:
    _, output = run(source)
    assert output.printed


def test_two_scripts_draw_different_random_numbers() -> None:
    source = "import random, numpy\nprint(random.random(), numpy.random.rand())"
    first, second = run(source)[1].printed, run(source)[1].printed
    assert len({*first.split(), *second.split()}) == 4
