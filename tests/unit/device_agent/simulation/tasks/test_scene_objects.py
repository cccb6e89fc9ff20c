"""A seeded reset places the objects of a scene, and nothing else."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import robot_type, tasks
from device_agent.simulation.tasks.free_body import FreeBody
from device_agent.simulation.tasks.scene_objects import SceneObjects, objects_of
from device_agent.simulation.world import World
from tests.harness.paths import ROBOTS, UR5

FOLDER = ROBOTS / "ur5_gripper"
HALF_M = {"red_cube": 0.02, "blue_cube": 0.015, "yellow_block": 0.025}
"""Half of the height in the model."""
NAMES = tuple(HALF_M)
LOW_RAD = {"shoulder_lift": -0.98, "elbow": 1.95, "wrist_1": -2.54}
"""The gripper is close to the table."""


class Scene:
    """The scene of the UR5 with a gripper, stepped manually."""

    def __init__(self, **home: float) -> None:
        kind = robot_type.load(FOLDER)
        self.joints = [joint.name for joint in kind.joints]
        self.world = World(FOLDER / kind.scene, home=kind.home_rad | home, real_time=False)
        found = objects_of(self.world)
        assert found is not None
        self.objects = found
        self.world.open()
        self.model: Any = self.world.model
        self.data: Any = self.world._data
        self.objects.resolve(self.model)

    def reset(self, seed: int) -> str:
        """Reset; returns the rejection."""
        request = self.objects.request(seed)
        self.world.step(1)
        assert request.finished.is_set()
        return request.rejection

    def state(self) -> dict[str, tuple[float, ...]]:
        """Pose, mass, friction and half height of each object."""
        return {
            name: (
                *self.data.joint(name).qpos.tolist(),
                float(self.model.body(name).mass[0]),
                float(self.model.geom(name).friction[0]),
                float(self.model.geom(name).size[2]),
            )
            for name in NAMES
        }

    def put(self, name: str, position_m: Any) -> None:
        """Put an object somewhere."""
        self.data.joint(name).qpos[:3] = position_m
        mujoco.mj_kinematics(self.model, self.data)

    def drawer(self) -> tuple[float, float, float]:
        """Position [m], friction [N] and damping [N s/m] of the drawer."""
        dof = int(self.model.joint("drawer").dofadr[0])
        return (
            float(self.data.joint("drawer").qpos[0]),
            float(self.model.dof_frictionloss[dof]),
            float(self.model.dof_damping[dof]),
        )

    def robot_rad(self) -> list[float]:
        return [float(self.data.joint(name).qpos[0]) for name in self.joints]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_a_seed_determines_every_pose_mass_and_friction(scene: Scene) -> None:
    first = []
    for seed in (3, 4, 3):
        assert scene.reset(seed) == ""
        first.append(scene.state())
        scene.world.step(50)
    assert first[0] == first[2]
    assert first[0] != first[1]
    other = Scene()
    assert other.reset(3) == ""
    assert {name: values[7:] for name, values in other.state().items()} == {
        name: values[7:] for name, values in first[0].items()
    }


def test_objects_stay_in_their_ranges_with_a_gap_and_the_robot_keeps_its_joints(scene: Scene) -> None:
    before, drawn = scene.robot_rad(), set[float]()
    for seed in range(40):
        assert scene.reset(seed) == ""
        assert scene.robot_rad() == pytest.approx(before, abs=1e-6)
        places = []
        for each in (each for each in scene.objects.manifest.objects if each.name in NAMES):
            x, y, *_, mass_kg, friction, half_m = scene.state()[each.name]
            assert each.lower_m[0] - 1e-4 <= x <= each.upper_m[0] + 1e-4
            assert each.lower_m[1] - 1e-4 <= y <= each.upper_m[1] + 1e-4
            assert each.mass_kg[0] <= mass_kg <= each.mass_kg[1]
            assert each.friction[0] <= friction <= each.friction[1]
            share = half_m / HALF_M[each.name]
            assert each.size_scale[0] <= share <= each.size_scale[1]
            places.append((x, y))
            drawn |= {mass_kg, friction, share}
        distances = [np.hypot(a[0] - b[0], a[1] - b[1]) for a in places for b in places if a is not b]
        assert min(distances) > scene.objects.manifest.gap_m + 2 * 0.85 * 0.015
    assert len(drawn) == 40 * len(NAMES) * 3


def test_size_mass_and_all_that_depends_on_them_agree_with_a_compiled_model(scene: Scene) -> None:
    assert scene.reset(5) == ""
    assert scene.reset(6) == ""  # from the original values, not those of the last reset
    spec = mujoco.MjSpec.from_file(str(FOLDER / "scene.xml"))
    for name in NAMES:
        geom = spec.geom(name)
        geom.size = scene.model.geom(name).size
        geom.mass = float(scene.model.body(name).mass[0])
    compiled = spec.compile()
    for name in NAMES:
        ours, theirs = scene.model.body(name), compiled.body(name)
        assert scene.model.geom(name).size[2] != HALF_M[name]
        assert ours.inertia == pytest.approx(theirs.inertia)
        assert ours.subtreemass == pytest.approx(theirs.subtreemass)
        assert ours.invweight0 == pytest.approx(theirs.invweight0, rel=1e-3)
        dofs = slice(int(compiled.joint(name).dofadr[0]), int(compiled.joint(name).dofadr[0]) + 6)
        assert scene.model.dof_invweight0[dofs] == pytest.approx(compiled.dof_invweight0[dofs], rel=1e-3)
        geom = compiled.geom(name).id
        for field in ("geom_aabb", "geom_rbound"):
            assert getattr(scene.model, field)[geom] == pytest.approx(getattr(compiled, field)[geom])
        tree = int(compiled.body_bvhadr[theirs.id])
        assert scene.model.bvh_aabb[tree] == pytest.approx(compiled.bvh_aabb[tree], abs=1e-9)


def test_the_light_changes_within_its_range(scene: Scene) -> None:
    original = scene.model.light_diffuse.copy()
    shares = []
    for seed in range(20):
        assert scene.reset(seed) == ""
        shares.append(float((scene.model.light_diffuse / original).mean()))
    lowest, highest = scene.objects.manifest.light
    assert lowest <= min(shares) < 0.8
    assert 1.0 < max(shares) <= highest


def test_objects_rest_after_a_reset(scene: Scene) -> None:
    assert scene.reset(8) == ""
    placed = scene.state()
    scene.world.step(500)
    for name, values in scene.state().items():
        assert values[:3] == pytest.approx(placed[name][:3], abs=1e-3)


def test_a_robot_near_an_object_prevents_the_reset_and_nothing_moves() -> None:
    scene = Scene(**LOW_RAD)
    pad = scene.model.body("finger_1").geomadr[0] + 1
    scene.put("red_cube", scene.data.geom_xpos[pad])
    before = scene.state()["blue_cube"]
    assert "is within 20 mm of 'red_cube'; open the gripper and move the robot away" in scene.reset(1)
    assert scene.state()["blue_cube"] == pytest.approx(before, abs=1e-3)


def test_a_moving_robot_prevents_the_reset(scene: Scene) -> None:
    scene.data.joint("shoulder_pan").qvel[0] = 0.5
    assert scene.reset(1) == "'shoulder' moves; reset the objects while every robot is at rest"
    scene.world.step(500)
    scene.data.joint("red_cube").qvel[0] = 0.5
    assert scene.reset(1) == ""


def test_a_robot_at_a_new_place_prevents_the_reset_and_nothing_moves() -> None:
    scene = Scene(**LOW_RAD)
    x, y, _ = scene.data.site("grip").xpos
    manifest = tasks.parse(
        f"""
        [[objects]]
        name = "red_cube"
        lower_m = [{x}, {y}]
        upper_m = [{x}, {y}]
        mass_kg = [0.1, 0.1]
        friction = [1.0, 1.0]
        size_scale = [2.0, 2.0]
        """
    )
    for name, place in zip(NAMES, (0.2, 0.3, 0.4), strict=True):
        scene.put(name, (place, 0.4, 0.03))
    objects = SceneObjects(manifest)
    objects.resolve(scene.model)
    scene.world.add(objects)
    request = objects.request(1)
    before = scene.state()
    scene.world.step(1)
    assert "of the new place of 'red_cube'" in request.rejection
    assert scene.state()["red_cube"][:2] == before["red_cube"][:2]
    assert scene.state()["red_cube"][-1] == HALF_M["red_cube"]


def test_a_reset_sets_the_joints_of_the_scene_within_their_ranges(scene: Scene) -> None:
    (joint,) = scene.objects.manifest.joints
    drawn = set[tuple[float, float, float]]()
    for seed in (1, 2, 3, 1):
        scene.data.joint("drawer").qpos[0], scene.data.joint("drawer").qvel[0] = 0.19, 0.3
        assert scene.reset(seed) == ""
        position, friction, damping = scene.drawer()
        assert joint.position[0] - 1e-4 <= position <= joint.position[1] + 1e-4
        assert joint.friction[0] <= friction <= joint.friction[1]
        assert joint.damping[0] <= damping <= joint.damping[1]
        assert abs(float(scene.data.joint("drawer").qvel[0])) < 1e-3
        drawn.add((round(position, 4), friction, damping))
    assert len(drawn) == 3


def test_a_robot_near_the_drawer_prevents_the_reset_and_a_moving_drawer_does_not() -> None:
    scene = Scene(**LOW_RAD)
    finger_m = scene.data.geom_xpos[scene.model.body("finger_1").geomadr[0]]
    scene.model.body("drawer").pos[:] = finger_m + np.array([0.0, 0.03, 0.0])
    mujoco.mj_kinematics(scene.model, scene.data)
    before = scene.state()["blue_cube"]
    assert "is within 20 mm of 'drawer'; open the gripper" in scene.reset(1)
    assert scene.state()["blue_cube"] == pytest.approx(before, abs=1e-3)
    other = Scene()
    other.data.joint("drawer").qvel[0] = 0.5
    assert other.reset(1) == ""


def test_a_drawer_slides_within_its_range_and_does_not_jam(scene: Scene) -> None:
    assert scene.reset(1) == ""
    for force_n, place_m in ((-30.0, 0.0), (30.0, 0.2)):
        scene.data.joint("drawer").qfrc_applied[0] = force_n
        scene.world.step(1500)
        assert scene.drawer()[0] == pytest.approx(place_m, abs=5e-3)


def test_a_missing_joint_is_an_error(scene: Scene) -> None:
    text = (FOLDER / "tasks.toml").read_text(encoding="utf-8")
    text = text.replace('name = "peg"', 'name = "pin"', 1).replace('object = "peg"', 'object = "pin"')
    for wrong in ("peg", "door"):
        manifest = tasks.parse(text.replace('"drawer"', f'"{wrong}"'))
        with pytest.raises(DriverError, match=f"the scene has no hinge or slide joint '{wrong}'"):
            SceneObjects(manifest).resolve(scene.model)


def test_ranges_without_room_are_an_error(scene: Scene) -> None:
    text = (FOLDER / "tasks.toml").read_text(encoding="utf-8").replace("light = ", "gap_m = 0.5\nlight = ", 1)
    objects = SceneObjects(tasks.parse(text))
    objects.resolve(scene.model)
    scene.world.add(objects)
    request = objects.request(1)
    scene.world.step(1)
    assert "leave no place for 'blue_cube' with a gap of 0.5 m" in request.rejection


def test_an_object_without_a_free_joint_is_an_error(scene: Scene) -> None:
    text = (FOLDER / "tasks.toml").read_text(encoding="utf-8")
    for wrong in ("finger_1", "cup"):
        with pytest.raises(DriverError, match=f"the scene has no body '{wrong}' with a free joint"):
            SceneObjects(tasks.parse(text.replace('"red_cube"', f'"{wrong}"'))).resolve(scene.model)


def test_a_wrong_manifest_is_an_error_and_a_scene_without_one_has_no_objects(tmp_path: Path) -> None:
    assert objects_of(World(UR5 / "scene.xml")) is None
    (tmp_path / "tasks.toml").write_text("objects = 3", encoding="utf-8")
    with pytest.raises(DriverError, match=r"tasks\.toml: Expected `array`"):
        objects_of(World(tmp_path / "scene.xml"))


def test_poses_are_in_the_frame_of_the_base(scene: Scene) -> None:
    scene.data.joint("red_cube").qpos[:] = [-0.4, 0.05, 0.02, np.cos(0.25), 0, 0, np.sin(0.25)]
    scene.world.step(2)
    values = scene.objects.poses(scene.world.snapshot(), int(scene.model.body("base").id))
    assert [values[f"{field}.red_cube"] for field in ("x_m", "y_m", "z_m")] == pytest.approx(
        [-0.4, 0.05, 0.02], abs=1e-3
    )
    assert values["yaw_rad.red_cube"] == pytest.approx(0.5, abs=1e-2)
    assert [values[f"{field}.yellow_block"] for field in ("length_m", "width_m", "height_m")] == [0.07, 0.05, 0.05]
    assert scene.reset(1) == ""
    values = scene.objects.poses(scene.world.snapshot(), int(scene.model.body("base").id))
    half = scene.model.geom("yellow_block").size
    assert [values[f"{field}.yellow_block"] for field in ("length_m", "width_m", "height_m")] == pytest.approx(
        2 * half, abs=1e-5
    )
    assert values["length_m.yellow_block"] != 0.07


def test_the_pose_of_a_drawer_is_that_of_its_body(scene: Scene) -> None:
    scene.data.joint("drawer").qpos[0] = 0.1
    scene.world.step(2)
    values = scene.objects.poses(scene.world.snapshot(), int(scene.model.body("base").id))
    assert values["position.drawer"] == pytest.approx(0.1, abs=1e-3)
    assert [values[f"{field}_m.drawer"] for field in "xyz"] == pytest.approx([-0.283, -0.48, 0.083], abs=1e-3)
    assert values["yaw_rad.drawer"] == 0.0
    assert "length_m.drawer" not in values


def test_a_mesh_cannot_be_an_object() -> None:
    model: Any = mujoco.MjModel.from_xml_string(
        """
        <mujoco>
          <asset><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
          <worldbody><body name="cup"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>
        </mujoco>
        """
    )
    with pytest.raises(DriverError, match="a shape of 'cup' is a mesh"):
        FreeBody(model, "cup")
