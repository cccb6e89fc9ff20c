"""Operators and scripts use the simulated gripper and the reset of the objects as any control, in real time."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent import geometry
from device_agent.drivers import load
from device_agent.protocol import Description, Measurements, SetControl, topics
from device_agent.protocol.manifests import robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import ROBOTS

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "ur5_gripper"


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    kind = robot_type.load(FOLDER)
    driver = load("mujoco")(kind, FOLDER, {}, "arm")
    harness = DeviceHarness(tmp_path, driver=driver, kind=kind, geometry=geometry.load(kind, FOLDER))  # type: ignore[arg-type]
    harness.start()
    yield harness
    harness.stop()


def test_actions_set_the_gripper_and_reset_the_objects(harness: DeviceHarness) -> None:
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[-1]
    assert [each.name for each in described.controls] == ["gripper", "reset_objects"]
    assert {"set_control", "move_joints", "move_pose"} <= set(described.actions)
    applied = harness.done(SetControl(control="gripper", value=1.0), epoch=1).result["applied"]
    assert applied["gripper"] == pytest.approx(1.0, abs=0.02)
    closed = eventually(
        lambda: [
            each
            for each in harness.published(topics.TELE, Measurements, "gripper")
            if each.values["closed"] > 0.97 and not each.values["holds"]
        ]
    )
    assert closed
    assert (
        harness.done(SetControl(control="reset_objects", value=3.0), epoch=1).result["applied"]["reset_objects"] == 3.0
    )
    assert harness.failed(SetControl(control="gripper", value=2.0), epoch=1).code == "out_of_range"


def test_a_script_resets_the_objects_and_reads_their_poses(harness: DeviceHarness) -> None:
    source = """
robot.set_control("reset_objects", 3)
wait(0.5)
values = robot.state()["streams"]["objects"]["values"]
print(abs(values["z_m.red_cube"] - values["height_m.red_cube"] / 2) < 0.001, "set_control" in robot.can)
"""
    assert harness.done(harness.script(source), epoch=1).output == "True True\n"


def test_stop_rejects_a_reset(harness: DeviceHarness) -> None:
    harness.receive_stop()
    eventually(lambda: harness.device._controller.latch)
    assert harness.failed(SetControl(control="reset_objects", value=3.0), epoch=1).code == "stopped"
