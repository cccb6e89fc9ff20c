"""What every robot folder must be."""

import ast
import runpy
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.protocol import topics
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import FOLDERS, MOVEMENTS, SHIPPED, Bench

pytestmark = pytest.mark.filterwarnings("error")
folders = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


def test_there_is_a_ur5():
    assert "ur5" in [folder.name for folder in FOLDERS]


@folders
def test_folder_has_its_files(folder: Path):
    manifest = robot_type.load(folder)
    assert (folder / manifest.model).is_file()
    assert (folder / manifest.scene).is_file()
    readme = (folder / "README.md").read_text(encoding="utf-8")
    assert "approximate" in readme.lower(), "the README says what is approximate"
    assert "source" in readme.lower(), "the README says where figures come from"


@folders
def test_manifest_and_model_name_the_same_joints_and_actuators(folder: Path):
    manifest = robot_type.load(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / manifest.model))
    names = {joint.name for joint in manifest.joints}
    actuators = {model.actuator(index).name for index in range(model.nu)}
    joints = {model.joint(index).name for index in range(model.njnt)}
    assert names <= actuators
    assert names <= joints
    for name in names:
        assert model.actuator(name).trnid[0] == model.joint(name).id
    known = {model.site(index).name for index in range(model.nsite)} | {
        model.body(index).name for index in range(model.nbody)
    }
    assert set(manifest.frames) <= known


@folders
def test_model_has_one_top_level_body_its_base(folder: Path):
    manifest = robot_type.load(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / manifest.model))
    assert sum(model.body_parentid[1:] == 0) == 1


@folders
def test_limits_of_manifest_joint_and_actuator_agree(folder: Path):
    bench = Bench(folder)
    for joint in bench.type.joints:
        in_model, actuator = bench.model.joint(joint.name), bench.model.actuator(joint.name)
        assert in_model.range[0] <= joint.lower_rad < joint.upper_rad <= in_model.range[1]
        assert bench.model.actuator_ctrllimited[actuator.id]
        assert in_model.range[0] <= actuator.ctrlrange[0] < actuator.ctrlrange[1] <= in_model.range[1]
        assert actuator.forcerange[1] == pytest.approx(joint.max_effort_nm)
        assert actuator.forcerange[0] == pytest.approx(-joint.max_effort_nm)
        for limit in (joint.max_velocity_rad_s, joint.max_acceleration_rad_s2, joint.max_jerk_rad_s3):
            assert limit > 0
        assert bench.type.braking_rad_s2 > joint.max_acceleration_rad_s2


@folders
def test_home_is_inside_the_limits_and_touches_nothing_new(folder: Path):
    bench = Bench(folder)
    assert np.all(bench.lower <= bench.home)
    assert np.all(bench.home <= bench.upper)
    start = bench.touching()
    mujoco.mj_step(bench.model, bench.data, nstep=500)
    assert bench.touching() == start
    assert not {pair for pair in start if "world" not in pair}, "the robot touches itself at home"


@folders
def test_home_is_held_still(folder: Path):
    bench = Bench(folder)
    mujoco.mj_step(bench.model, bench.data, nstep=1000)
    assert np.abs(bench.data.qpos[bench.qpos] - bench.home).max() < 1e-3
    assert np.abs(bench.data.qvel[bench.dof]).max() < 1e-3


@folders
@pytest.mark.parametrize("seed", range(3))
def test_noise_on_every_actuator_gives_no_warning(folder: Path, seed: int):
    bench = Bench(folder)
    noise = np.random.default_rng(seed)
    for step in range(2000):
        if step % 10 == 0:  # a new random target every 20 ms: jumps that no agent would send
            bench.data.ctrl[bench.ctrl] = noise.uniform(bench.lower, bench.upper)
        mujoco.mj_step(bench.model, bench.data)
    assert not bench.data.warning.number.any()
    assert np.isfinite(bench.data.qpos).all()
    assert np.isfinite(bench.data.qvel).all()


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_shipped_type_has_at_least_five_movements(folder: Path):
    assert sum(path.parent.parent == folder for path in MOVEMENTS) >= 5


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_names_that_robots_of_one_world_share_begin_with_the_type(folder: Path):
    manifest = robot_type.load(folder)
    tree = ET.parse(folder / manifest.model).getroot()  # noqa: S314 - our own file
    named = [each.get("class", "") for each in tree.iter("default")]
    named += [each.get("name", "") for kind in ("material", "texture") for each in tree.iter(kind)]
    assert [name for name in named if name and not name.startswith(folder.name)] == []


@folders
def test_named_poses_are_collision_free(folder: Path):
    manifest = robot_type.load(folder)
    shape = geometry.load(manifest, folder)
    if shape is None:
        return
    for kind in ("expressions", "visemes"):
        for name, pose in getattr(manifest, kind).items():
            position = manifest.home_rad | pose
            room = shape.clearance([position[joint.name] for joint in manifest.joints])
            assert room.room_m >= 0, f"{kind} {name}: {room.text}"


@folders
def test_movements_are_offered_when_the_manifest_says_so(folder: Path):
    has = any(path.parent.parent == folder for path in MOVEMENTS)
    assert has == ("movements" in robot_type.load(folder).capabilities)


@pytest.mark.parametrize("path", MOVEMENTS, ids=lambda path: f"{path.parent.parent.name}-{path.stem}")
def test_movement_is_a_script_with_a_description(path: Path):
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    described = (ast.get_docstring(tree) or "").splitlines()
    assert described
    assert described[0].endswith(".")
    assert topics.is_id(path.stem)
    assert len(source) <= 64_000, "the wire contract's longest script"


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_drawings_are_up_to_date(folder: Path):
    draw = runpy.run_path(str(ROBOTS / "draw.py"))
    assert (folder / "drawing.json").read_bytes() == draw["drawing"](folder), "run python robots/draw.py"
