"""A sandboxed script moves the simulated UR5 by joints and poses within its limits."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent import drivers, geometry
from device_agent.config.catalogue import TYPES
from device_agent.protocol import AckStatus
from device_agent.protocol.manifests.shipped import ROBOTS
from function_app.services.robot_types.script_linter import check_script
from tests.harness.agent.device_harness import DeviceHarness
from tests.harness.paths import ROOT

UR5 = ROBOTS / "ur5"
KEYFRAMES = ROOT / "web" / "tests" / "fixtures" / "keyframes.py"
"""Output of the keyframe editor; the web tests compare with it too."""


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[DeviceHarness]:
    kind = TYPES.load("ur5")
    driver = drivers.load(kind.driver)(kind, UR5, {}, "arm")
    harness = DeviceHarness(tmp_path, driver=driver, kind=kind, geometry=geometry.load(kind, UR5))  # type: ignore[arg-type]
    harness.device.start()
    harness.device.link_changed(True)
    yield harness
    harness.stop()


def test_a_frame_reaches_its_pose(arm: DeviceHarness) -> None:
    source = (
        "import json\n"
        "robot.home(speed=1)\n"
        "down = robot.state()['frames']['flange']\n"
        "robot.move_to((down[0], down[1] + 0.1, down[2] + 0.05), speed=1)\n"
        "wait(0.5)\n"
        "raised = robot.state()['frames']['flange']\n"
        "robot.move_to(down[:3], quaternion=down[3:], frame='flange', speed=1)\n"
        "wait(0.5)\n"
        "print(json.dumps([down, raised, robot.state()['frames']['flange']]))\n"
    )
    ack = arm.end(arm.command(arm.script(source), epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    down, raised, again = json.loads(ack.output)
    wanted = (down[0], down[1] + 0.1, down[2] + 0.05)
    assert math.dist(raised[:3], wanted) < 2e-3
    assert math.dist(again[:3], down[:3]) < 2e-3
    assert abs(sum(a * b for a, b in zip(raised[3:], down[3:], strict=True))) > 0.9999, "it keeps its orientation"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("robot.move_to((5, 0, 0))", "line 1: found no joint position for flange"),
        ("robot.move_to((-0.4, 0.0, -0.2))", "line 1: flange cannot reach this pose"),
        ("robot.say('hello')", "this robot has no say; it has move_joints, move_to, play, home, state, latest"),
        ("robot.drive(1)", "this robot has no drive"),
        ("robot.look((1, 0, 0))", "this robot has no look"),
    ],
)
def test_motions_outside_the_limits_are_rejected(arm: DeviceHarness, call: str, message: str) -> None:
    reason = arm.end(arm.command(arm.script(call), epoch=1)).reason
    assert reason is not None
    assert message in reason.message


def test_a_script_of_the_keyframe_editor_is_played(arm: DeviceHarness) -> None:
    source = KEYFRAMES.read_text()
    assert check_script(source, TYPES.load("ur5")).marks == ()
    source += "\nimport json\nprint(json.dumps(robot.state()['position_rad']))\n"
    ack = arm.end(arm.command(msgspec.structs.replace(arm.script(source), parameters={"speed": 2}), epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    position_rad = json.loads(ack.output)
    assert (position_rad["shoulder_pan"], position_rad["elbow"]) == pytest.approx((0.5, 1.57), abs=0.02)
