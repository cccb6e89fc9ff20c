"""Robot geometry, compared with MuJoCo's contacts and dense sampling."""

import math
import sys
from pathlib import Path
from typing import Any

import mink
import msgspec
import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.geometry.mujoco_geometry import MujocoGeometry
from device_agent.ports.geometry import GeometryError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import Base
from tests.harness.paths import UR5

pytestmark = pytest.mark.slow
KIND = robot_type.load(UR5)
HOME = [KIND.home_rad[joint.name] for joint in KIND.joints]
LOWER = np.array([joint.lower_rad for joint in KIND.joints])
UPPER = np.array([joint.upper_rad for joint in KIND.joints])


@pytest.fixture(scope="module")
def shape() -> MujocoGeometry:
    return MujocoGeometry(KIND, UR5 / KIND.scene)


def positions(count: int, seed: int) -> Any:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, len(LOWER)))


def free(shape: MujocoGeometry, count: int, seed: int) -> list[Any]:
    found = [position for position in positions(20 * count, seed) if shape.clearance(position.tolist()).excess_m > 0]
    assert len(found) >= count
    return found[:count]


@pytest.fixture
def simulated() -> tuple[Any, Any]:
    """Model and data of the arm's scene."""
    model = mujoco.MjModel.from_xml_path(str(UR5 / KIND.scene))
    return model, mujoco.MjData(model)


def test_contacts_have_no_clearance(shape: MujocoGeometry, simulated: tuple[Any, Any]) -> None:
    model, data = simulated
    touching = 0
    for position in positions(400, 1):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if (data.contact.dist < 0).any():
            touching += 1
            assert shape.clearance(position.tolist()).excess_m < 0
    assert touching > 50
    assert shape.clearance(HOME).excess_m > 0.02


def test_sweeps_agree_with_sampling(shape: MujocoGeometry) -> None:
    random = np.random.default_rng(3)
    blocked = 0
    for start in free(shape, 120, 2):
        end = start + random.uniform(-0.5, 0.5, len(start))
        swept = shape.sweep([start, (start + end) / 2, end])
        share = swept.share
        for part in np.linspace(0, share, 40):
            assert shape.clearance((start + part * (end - start)).tolist()).excess_m > -0.01
        if swept.clearance is not None:
            blocked += 1
            assert swept.clearance.excess_m < 0
            beyond = [start + part * (end - start) for part in np.linspace(share, 1, 60)]
            assert min(shape.clearance(position.tolist()).excess_m for position in beyond) < 0
        else:
            assert share == 1.0
    assert 20 < blocked < 100


def test_cached_bounds_agree_with_measurements(shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(8)
    measuring = MujocoGeometry(KIND, UR5 / KIND.scene)
    monkeypatch.setattr(measuring._checker, "_clear_by_bounds", lambda _: False)
    counts = {True: 0, False: 0}
    for start in free(shape, 25, 4):
        heading = random.uniform(-0.06, 0.06, len(start))
        for _ in range(20):
            path = [start, start + heading, start + 4 * heading]
            found = shape.sweep(path)
            assert found == measuring.sweep(path)
            counts[found.clearance is None] += 1
            start = start + heading  # noqa: PLW2901 (a walk)
    assert min(counts.values()) > 50


def test_a_violated_margin_may_only_grow(shape: MujocoGeometry) -> None:
    low, away, on = ([0.0, lift, *HOME[2:]] for lift in (-0.86, -1.0, -0.80))
    assert shape.clearance(low).excess_m < 0
    assert shape.sweep([low, away]).share == 1.0
    stopped = shape.sweep([low, on])
    assert stopped.share == 0.0
    assert stopped.clearance is not None
    assert stopped.clearance.text == "clearance: table_top \u2013 wrist_3_link"


def test_glance_estimates_the_clear_share(shape: MujocoGeometry) -> None:
    assert shape.glance(HOME, [1.0, *HOME[1:]]) == 1.0
    for lift in (-0.8, -0.5, 0.3):
        down = [0.0, lift, *HOME[2:]]
        assert shape.glance(HOME, down) == pytest.approx(shape.sweep([HOME, down]).share, abs=0.04)
    low = [0.0, -0.86, *HOME[2:]]
    assert shape.glance(low, HOME) == 1.0
    assert shape.glance(low, [0.0, 0.3, *HOME[2:]]) < 1.0, "another pair is too close on that path"


def test_no_point_is_faster_than_the_bound(shape: MujocoGeometry, simulated: tuple[Any, Any]) -> None:
    model, data = simulated
    random = np.random.default_rng(5)
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    boxes = [
        (geom, model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:])
        for geom in range(model.ngeom)
        if model.geom_contype[geom] and model.geom_bodyid[geom]
    ]

    def corners(position: Any) -> Any:
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        return np.concatenate(
            [data.geom_xpos[geom] + box @ data.geom_xmat[geom].reshape(3, 3).T for geom, box in boxes]
        )

    step_s = 1e-5
    for position in positions(200, 4):
        velocity = random.uniform(-1, 1, len(position)) * random.integers(0, 2, len(position))
        speed = np.linalg.norm(corners(position + step_s * velocity) - corners(position), axis=1).max() / step_s
        assert speed <= shape.speed_m_s(velocity.tolist()) + 1e-6
    assert shape.speed_m_s([0.0] * len(HOME)) == 0.0


def test_the_workspace_keeps_frames_inside(shape: MujocoGeometry) -> None:
    position = [1.2, -0.05, 0.3, HOME[3], HOME[4], 0.0]  # next to the table, below its top
    clearance = shape.clearance(position)
    assert clearance.excess_m < 0
    narrow = msgspec.structs.replace(
        KIND, workspace=robot_type.Workspace(lower_m=(-0.6, -0.6, 0.0), upper_m=(0.6, 0.6, 0.5), frames=("flange",))
    )
    small = MujocoGeometry(narrow, UR5 / KIND.scene)
    up = [*HOME]
    up[2] = 0.6
    found = small.clearance(up)
    assert (found.kind, found.between) == ("workspace", ("flange", "upper z"))
    assert found.text == "workspace: flange \u2013 upper z"
    swept = small.sweep([HOME, up])
    assert 0.1 < swept.share < 1.0
    assert swept.clearance is not None
    assert swept.clearance.kind == "workspace"
    assert small.sweep([up, HOME]).share == 1.0


def test_poses_are_those_of_the_model(shape: MujocoGeometry, simulated: tuple[Any, Any]) -> None:
    model, data = simulated
    matrix = np.empty(9)
    for position in positions(20, 6):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        poses = shape.poses(position.tolist())
        assert set(poses) == set(shape.frames) == set(KIND.frames)
        for name, pose in poses.items():
            assert pose[:3] == pytest.approx(data.site(name).xpos, abs=1e-9)
            mujoco.mju_quat2Mat(matrix, np.array(pose[3:]))
            assert matrix == pytest.approx(data.site(name).xmat, abs=1e-9)
            assert pose[3] >= 0


def test_inverse_kinematics_finds_reachable_poses_near_the_start(shape: MujocoGeometry) -> None:
    for position in free(shape, 12, 7):
        target = shape.poses(position.tolist())["flange"]
        solution = shape.solve("flange", target, HOME)
        pose = shape.poses(solution)["flange"]
        assert pose[:3] == pytest.approx(target[:3], abs=2e-4)
        assert abs(np.dot(pose[3:], target[3:])) == pytest.approx(1.0, abs=1e-6)
        assert np.array_equal(solution, np.clip(solution, LOWER, UPPER))
        assert shape.clearance(solution).excess_m >= 0
    x, y, z, *turn = shape.poses(HOME)["flange"]
    nearby = shape.solve("flange", (x, y + 0.05, z - 0.05, *turn), HOME)  # type: ignore[arg-type]
    assert np.abs(np.subtract(nearby, HOME)).max() < 0.3


def test_an_unsolvable_step_ends_the_attempt(shape: MujocoGeometry, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsolved(*_: Any, **__: Any) -> Any:
        raise mink.NoSolutionFound("daqp")

    monkeypatch.setattr(mink, "solve_ik", unsolved)
    x, y, z, *turn = shape.poses(HOME)["flange"]
    with pytest.raises(GeometryError, match="found no joint position"):
        shape.solve("flange", (x, y + 0.05, z, *turn), HOME)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("frame", "pose", "message"),
    [
        ("hand", (0.3, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0), "available frames: shoulder_pan"),
        ("flange", (2.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0), "found no joint position for flange: the closest one is"),
        ("flange", (-0.5, -0.1, 0.005, 0.0, 0.7071068, 0.7071068, 0.0), "flange cannot reach this pose: "),
        ("flange", (0.3, math.nan, 0.3, 1.0, 0.0, 0.0, 0.0), "finite"),
        ("flange", (0.3, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0), "quaternion"),
    ],
)
def test_unreachable_poses_are_rejected(shape: MujocoGeometry, frame: str, pose: Any, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        shape.solve(frame, pose, HOME)


def test_types_without_model_have_no_geometry_and_missing_mujoco_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert geometry.load(msgspec.structs.replace(KIND, model="", workspace=None), UR5) is None
    monkeypatch.setitem(sys.modules, "device_agent.geometry.mujoco_geometry", None)
    with pytest.raises(GeometryError, match="install mujoco-core"):
        geometry.load(KIND, UR5)


@pytest.mark.parametrize(
    ("change", "scene", "message"),
    [
        ({}, "nowhere.xml", "cannot build"),
        (
            {"joints": (msgspec.structs.replace(KIND.joints[0], name="knee"),), "home_rad": {"knee": 0.0}},
            KIND.scene,
            "no joint 'knee'",
        ),
        ({"frames": ("nose",), "workspace": None}, KIND.scene, "no site or body 'nose'"),
        ({"home_rad": KIND.home_rad | {"shoulder_lift": 0.0}}, KIND.scene, "the home position is too close"),
    ],
)
def test_a_mismatched_model_is_rejected(change: dict[str, Any], scene: str, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        MujocoGeometry(msgspec.structs.replace(KIND, **change), UR5 / scene)


CART = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 0.1"/>
  <body name="cart" pos="0 0 0.1"><freejoint/>
    <geom type="box" size="0.2 0.2 0.1"/>
    <body name="mast" pos="0 0 0.1"><joint name="lift" type="slide" axis="0 0 1" range="0 0.3"/>
      <geom type="capsule" fromto="0 0 0.1 0 0 0.4" size="0.03"/>
      <body name="arm" pos="0.02 0 0.4"><joint name="swing" pos="0.01 0 0" axis="0 1 0" range="-3 3"/>
        <geom type="capsule" fromto="0.1 0 0 0.4 0 0" size="0.03"/>
        <site name="tip" pos="0.4 0 0"/>
        <geom name="ghost" type="sphere" size="0.5" contype="2" conaffinity="2"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""


def test_a_mobile_robot_is_only_checked_against_itself(tmp_path: Path) -> None:
    (tmp_path / "cart.xml").write_text(CART)
    joint = KIND.joints[0]
    kind = msgspec.structs.replace(
        KIND,
        joints=(
            msgspec.structs.replace(joint, name="lift", lower_rad=0.0, upper_rad=0.3),
            msgspec.structs.replace(joint, name="swing", lower_rad=-3.0, upper_rad=3.0),
        ),
        home_rad={"lift": 0.1, "swing": 0.0},
        frames=("tip", "arm"),
        workspace=None,
        base=msgspec.convert(dict.fromkeys(Base.__struct_fields__[:6], 1.0), Base),
    )
    cart = MujocoGeometry(kind, tmp_path / "cart.xml")
    assert cart.clearance([0.0, 1.4]).between == ("cart", "arm")
    assert cart.clearance([0.3, 0.0]).excess_m > 0.2
    assert "arm" in cart.poses([0.1, 0.0])
    assert cart.speed_m_s([1.0, 0.0]) == pytest.approx(1.0)
    with pytest.raises(GeometryError, match="floor"):
        MujocoGeometry(msgspec.structs.replace(kind, base=None), tmp_path / "cart.xml")


def test_another_scene_can_be_selected(tmp_path: Path) -> None:
    scene = (UR5 / "scene.xml").read_text()
    post = '<geom name="post" type="cylinder" size="0.05 0.5" pos="-0.48 0.25 0.5"/>'
    (tmp_path / "post.xml").write_text(scene.replace("</worldbody>", f"{post}</worldbody>"))
    (tmp_path / "ur5.xml").write_bytes((UR5 / "ur5.xml").read_bytes())
    shape = geometry.load(KIND, tmp_path, scene="post.xml")
    assert shape is not None
    swept = shape.sweep([HOME, [-0.7, *HOME[1:]]])
    assert swept.clearance is not None
    assert "post" in swept.clearance.text


def room_with(tmp_path: Path, *objects: str) -> Path:
    room = tmp_path / "room.xml"
    room.write_text(
        '<mujoco><compiler angle="radian"/><option timestep="0.01" integrator="RK4"/><visual><map zfar="9"/></visual>'
        f'<worldbody><geom name="floor" type="plane" size="5 5 1"/>{"".join(objects)}</worldbody></mujoco>'
    )
    return room


def in_room(room: Path, yaw_rad: float = 0.7) -> MujocoGeometry:
    base_pose = geometry.BasePose(room=room, position_m=(2.0, -1.0, 0.75), yaw_rad=yaw_rad)
    return MujocoGeometry(KIND, UR5 / KIND.model, base_pose=base_pose)


def test_poses_in_a_room_are_relative_to_the_base_and_moving_or_far_objects_are_left_out(
    shape: MujocoGeometry, tmp_path: Path
):
    gate = '<geom name="gate" type="box" size="0.05 0.4 0.4"/>'
    swinging = f'<body pos="1.5 -1 1"><joint name="swing" type="hinge"/>{gate}</body>'
    far = '<geom name="far" type="box" size="0.1 0.1 0.1" pos="-3 3 1"/>'
    placed = in_room(room_with(tmp_path, swinging, far))
    names = {name for pair in placed._pairs._names for name in pair}
    assert "floor" in names
    assert not {"gate", "far"} & names
    for name, pose in shape.poses(HOME).items():
        assert placed.poses(HOME)[name] == pytest.approx(pose, abs=1e-9)
    assert placed.solve("flange", shape.poses(HOME)["flange"], HOME) == pytest.approx(HOME, abs=1e-2)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, -2.2])
def test_room_objects_are_transformed_by_the_base_pose(tmp_path: Path, yaw_rad: float):
    # At the flange's distance from the base.
    x, y = -0.36, -0.36
    position = (
        2.0 + x * math.cos(yaw_rad) - y * math.sin(yaw_rad),
        -1.0 + x * math.sin(yaw_rad) + y * math.cos(yaw_rad),
    )
    post = f'<geom name="post" type="cylinder" size="0.05 0.6" pos="{position[0]} {position[1]} 1.3"/>'
    placed = in_room(room_with(tmp_path, post), yaw_rad=yaw_rad)
    swept = placed.sweep([HOME, [HOME[0] + 1.0, *HOME[1:]]])
    assert swept.clearance is not None
    assert swept.clearance.between[0] == "post"
    assert swept.share == pytest.approx(0.4, abs=0.1)
    assert placed.sweep([HOME, [HOME[0] - 1.0, *HOME[1:]]]).share == 1.0
