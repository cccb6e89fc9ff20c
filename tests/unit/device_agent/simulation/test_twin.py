"""The twin's kinematics equal the simulation's."""

import json
import math
import runpy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from device_agent.drivers.mujoco import build_twin
from device_agent.ports.driver import DriverError
from device_agent.protocol import Twin, codec
from device_agent.protocol.manifests import robot_type
from device_agent.simulation.mjcf.equality_joints import EqualityJoints
from tests.harness.paths import ROBOTS

FOLDERS = sorted(path.parent for path in ROBOTS.glob("*/robot.toml"))
Matrix = npt.NDArray[np.float64]


def rotation(quaternion: Any) -> Matrix:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array(quaternion) / np.linalg.norm(quaternion))
    return matrix.reshape(3, 3)


def transform(turn: Matrix, position: Any = (0.0, 0.0, 0.0)) -> Matrix:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, position
    return pose


def geometry_poses(twin: Twin, position_rad: dict[str, float]) -> list[Matrix]:
    """Forward kinematics of the twin in the base's frame: one 4x4 pose per shape."""
    bodies: list[Matrix] = []
    shapes: list[Matrix] = []
    for body in twin.bodies:
        pose = bodies[body.parent] if body.parent >= 0 else np.eye(4)
        pose = pose @ transform(rotation(body.quaternion), body.position_m)
        if body.joint is not None:
            at = position_rad.get(body.joint.name, body.joint.reference_rad)
            if body.joint.follows:
                at = sum(factor * position_rad.get(name, 0.0) for name, factor in body.joint.follows.items())
            moved = at - body.joint.reference_rad
            axis, anchor = np.array(body.joint.axis), np.array(body.joint.anchor_m)
            if body.joint.kind == "slide":
                pose = pose @ transform(np.eye(3), axis * moved)
            else:
                turn = rotation((np.cos(moved / 2), *(np.sin(moved / 2) * axis)))
                pose = pose @ transform(turn, anchor - turn @ anchor)
        bodies.append(pose)
        shapes += [pose @ transform(rotation(shape.quaternion), shape.position_m) for shape in body.geometries]
    return shapes


def assert_same_poses(model: Any, twin: Twin, base: int, *, scenery: bool) -> None:
    data = mujoco.MjData(model)
    random, equality_joints = np.random.default_rng(11), EqualityJoints(model)
    visible = [geom for geom in range(model.ngeom) if model.geom_group[geom] <= 2]
    geoms = [geom for geom in visible if scenery and model.geom_bodyid[geom] == 0]
    geoms += [geom for geom in visible if model.body_rootid[model.geom_bodyid[geom]] == base]
    for _ in range(20):
        position = {}
        for joint in range(model.njnt):
            if model.jnt_type[joint] in (2, 3):  # slide, hinge
                value = random.uniform(-2, 2)
                data.qpos[model.jnt_qposadr[joint]] = value
                position[model.joint(joint).name] = value
        equality_joints.apply(data.qpos)
        mujoco.mj_kinematics(model, data)
        to_base = np.linalg.inv(transform(data.xmat[base].reshape(3, 3), data.xpos[base]))
        poses = geometry_poses(twin, position)
        assert len(poses) == len(geoms)
        for pose, geom in zip(poses, geoms, strict=True):
            simulated = to_base @ transform(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
            assert np.abs(pose - simulated).max() < 1e-9


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_forward_kinematics_of_the_twin_equals_the_simulation(folder: Path):
    manifest = robot_type.load(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / manifest.scene))
    base = int(model.body_rootid[model.jnt_bodyid[model.joint(manifest.joints[0].name).id]])
    twin = build_twin(model, base=base, device="arm", scenery_m=math.inf)
    read_back = codec.decode(codec.encode(twin, limit=codec.MAX_RETAINED_BYTES), Twin)
    # The twin of a mobile robot excludes the scene.
    assert_same_poses(model, read_back, base, scenery=bool(model.body_weldid[base] == 0))


MANY = """
<mujoco><worldbody>
  <body name="other" pos="5 0 0"><joint type="free"/><geom size="0.1"/></body>
  <body name="base" pos="1 2 3" euler="20 30 40">
    <geom type="box" size="0.1 0.2 0.3"/>
    <body name="gimbal" pos="0.1 0 0.2" euler="0 45 0">
      <joint name="yaw" axis="0 0 1" pos="0.02 0 0"/>
      <joint name="pitch" axis="0 1 0" pos="0 0 0.05" ref="30"/>
      <joint name="lift" type="slide" axis="1 0 1"/>
      <geom type="ellipsoid" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>
      <geom size="0.5" group="3"/>
      <body name="plate" pos="0 0 1"><geom type="capsule" size="0.1 0.2"/>
        <body name="tip" pos="0 0.3 0"><joint name="roll" axis="1 1 0"/><geom type="cylinder" size="0.1 0.2"/></body>
      </body>
    </body>
  </body>
  <geom type="plane" size="1 1 1"/>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("scenery", [True, False])
def test_bodies_with_several_joints(scenery: bool):
    model = mujoco.MjModel.from_xml_string(MANY)
    base = model.body("base").id
    twin = build_twin(model, base=base, device="x", scenery_m=math.inf if scenery else 0.0)
    assert_same_poses(model, twin, base, scenery=scenery)
    names = [body.name for body in twin.bodies]
    assert names == ["scene"] * scenery + ["base", "gimbal#0", "gimbal#1", "gimbal", "plate", "tip"]


def test_a_moving_base_is_the_origin():
    floating = MANY.replace('<body name="base" pos="1 2 3" euler="20 30 40">', '<body name="base"><freejoint/>')
    model = mujoco.MjModel.from_xml_string(floating)
    base = model.body("base").id
    twin = build_twin(model, base=base, device="x", scenery_m=math.inf)
    assert "scene" not in [body.name for body in twin.bodies], "static objects would move with the robot"
    assert_same_poses(model, twin, base, scenery=False)


def test_names_lose_their_prefix():
    child = mujoco.MjSpec.from_string(MANY.replace("<freejoint/>", ""))
    spec = mujoco.MjSpec()
    spec.attach(child, prefix="left/", frame=spec.worldbody.add_frame(pos=[1, 0, 0]))
    model = spec.compile()
    twin = build_twin(model, base=model.body("left/base").id, device="x", prefix="left/")
    assert "tip" in [body.name for body in twin.bodies]
    assert {body.joint.name for body in twin.bodies if body.joint} == {"yaw", "pitch", "lift", "roll"}


def test_a_mesh_becomes_its_bounding_box():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><mesh name="m" vertex="1 0 0  3 0 0  1 4 0  1 0 6"/></asset>
      <worldbody><body name="base"><geom type="mesh" mesh="m"/></body></worldbody></mujoco>""")
    (body,) = build_twin(model, base=1, device="x").bodies
    (shape,) = body.geometries
    assert shape.shape == "box"
    corners = np.array([[1, 0, 0], [3, 0, 0], [1, 4, 0], [1, 0, 6]], dtype=float)
    local = (corners - shape.position_m) @ rotation(shape.quaternion)
    assert np.all(np.abs(local) <= np.array(shape.size_m) + 1e-6)


def test_a_ball_joint_is_an_error():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body name="base"><geom size="1"/>
      <body><joint name="hip" type="ball"/><geom size="1"/></body></body></worldbody></mujoco>""")
    with pytest.raises(DriverError, match="joint 'hip' is neither a hinge nor a slide"):
        build_twin(model, base=1, device="x")


def test_colours_come_from_material_or_geom():
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><asset><material name="m" rgba="0.1 0.2 0.3 1"/></asset><worldbody><body name="base">
      <geom size="1" material="m"/><geom size="1" rgba="0.5 0.5 0.5 1"/><geom size="1" rgba="1 1 1 0"/>
      </body></worldbody></mujoco>""")
    (body,) = build_twin(model, base=1, device="x").bodies
    assert [shape.rgba for shape in body.geometries] == [(0.1, 0.2, 0.3, 1.0), (0.5, 0.5, 0.5, 1.0)]


def test_the_web_fixture_is_up_to_date() -> None:
    """If it fails, run ``.venv/bin/python web/tests/fixtures/make.py``."""

    def equal(one: Any, other: Any) -> bool:
        """Equal except for rounding differences."""
        if isinstance(one, dict):
            return one.keys() == other.keys() and all(equal(one[name], other[name]) for name in one)
        if isinstance(one, list | tuple):
            return len(one) == len(other) and all(map(equal, one, other))
        return bool(one == (pytest.approx(other, rel=1e-9, abs=1e-9) if isinstance(one, float) else other))

    fixtures = ROBOTS.parent / "web" / "tests" / "fixtures"
    content = runpy.run_path(str(fixtures / "make.py"))["content"]()
    assert equal(content, json.loads((fixtures / "ur5.json").read_text(encoding="utf-8")))
