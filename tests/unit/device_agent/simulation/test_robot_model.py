"""The model of a robot whose joints are measured: frames as in the geometry, and errors that name the file."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.simulation.mjcf.robot_model import RobotModel
from tests.harness.paths import ROBOTS, UR5


@pytest.mark.parametrize("name", ["hanson", "nao", "qbo", "ur5"])
def test_frames_are_those_of_the_geometry(name: str) -> None:
    kind = robot_types.load(ROBOTS / name)
    position = [
        min(kind.home_rad[joint.name] + 0.1 * number / len(kind.joints), joint.upper_rad)
        for number, joint in enumerate(kind.joints)
    ]
    model = RobotModel(kind, ROBOTS / name)
    expected = MujocoGeometry(kind, ROBOTS / name / kind.scene).poses(position)
    for frame, pose in zip(kind.frames, model.frames(position), strict=True):
        assert pose == pytest.approx(expected[frame], abs=1e-9)
    twin = model.twin("robot")
    assert twin is not None
    assert {joint.name for joint in kind.joints} <= {body.joint.name for body in twin.bodies if body.joint}


def test_a_type_without_model_and_frames_has_neither(tmp_path: Path) -> None:
    kind = replace(robot_types.load(UR5), model="", frames=())
    model = RobotModel(kind, tmp_path)
    assert model.twin("robot") is None
    assert model.frames([0.0] * 6) == ()


@pytest.mark.parametrize("change", [{"model": "missing.xml"}, {"frames": ("tail",)}])
def test_a_wrong_model_is_named(change: dict[str, object]) -> None:
    kind = replace(robot_types.load(UR5), **change)
    with pytest.raises(DriverError, match=str(change.get("model", "ur5.xml"))):
        RobotModel(kind, UR5).frames([0.0] * 6)
