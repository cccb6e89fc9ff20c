"""Requirements of every robot folder."""

import ast
import runpy
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest

from device_agent import geometry
from device_agent.drivers.mujoco import _driver_class
from device_agent.protocol import topics
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.actions.device_context import DeviceContext
from function_app.entrypoints.http.robot_types.serializers import robot_type_out
from function_app.services.robot_types.catalogue import KnownType
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import FOLDERS, MOVEMENTS, SHIPPED, SteppedRobot, contacts

pytestmark = pytest.mark.filterwarnings("error")
folders = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


@folders
def test_folder_has_its_files(folder: Path):
    manifest = robot_type.load(folder)
    assert (folder / manifest.model).is_file()
    assert (folder / manifest.scene).is_file()
    readme = (folder / "README.md").read_text(encoding="utf-8")
    assert "approximate" in readme.lower(), "the README lists what is approximate"
    assert "source" in readme.lower(), "the README names the sources of figures"
    has_movements = any(path.parent.parent == folder for path in MOVEMENTS)
    assert has_movements == ("movements" in manifest.capabilities)


@folders
def test_manifest_and_model_agree(folder: Path):
    manifest = robot_type.load(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / manifest.model))
    assert sum(model.body_parentid[1:] == 0) == 1, "its base is the only top-level body"
    sites = {model.site(index).name for index in range(model.nsite)}
    assert set(manifest.frames) <= sites | {model.body(index).name for index in range(model.nbody)}
    for joint in manifest.joints:
        in_model, actuator = model.joint(joint.name), model.actuator(joint.name)
        assert actuator.trnid[0] == in_model.id
        assert in_model.range[0] <= joint.lower_rad < joint.upper_rad <= in_model.range[1]
        assert model.actuator_ctrllimited[actuator.id]
        assert in_model.range[0] <= actuator.ctrlrange[0] < actuator.ctrlrange[1] <= in_model.range[1]
        assert actuator.forcerange == pytest.approx([-joint.max_effort_nm, joint.max_effort_nm])
        assert min(joint.max_velocity_rad_s, joint.max_acceleration_rad_s2, joint.max_jerk_rad_s3) > 0
        assert manifest.braking_rad_s2 > joint.max_acceleration_rad_s2


@folders
def test_home_is_inside_the_limits_and_held_still_without_contacts(folder: Path):
    bench = SteppedRobot(folder)
    assert np.all(bench.lower <= bench.home)
    assert np.all(bench.home <= bench.upper)
    start = contacts(bench.model, bench.data)
    assert all("world" in pair for pair in start), "the robot touches itself at home"
    bench.step(1000)
    assert contacts(bench.model, bench.data) == start
    assert np.abs(bench.data.qpos[bench.qpos] - bench.home).max() < 1e-3
    assert np.abs(bench.data.qvel[bench.dof]).max() < 1e-3


@pytest.mark.slow
@folders
@pytest.mark.parametrize("seed", range(3))
def test_noise_on_every_actuator_gives_no_warning(folder: Path, seed: int):
    bench = SteppedRobot(folder)
    noise = np.random.default_rng(seed)
    for _ in range(200):  # a new random target every 20 ms: jumps that no agent would send
        bench.data.ctrl[bench.ctrl] = noise.uniform(bench.lower, bench.upper)
        bench.step(10)
    assert not bench.data.warning.number.any()
    assert np.isfinite(bench.data.qpos).all()
    assert np.isfinite(bench.data.qvel).all()


@pytest.mark.slow
@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_shipped_type_has_movements_own_names_and_a_current_drawing(folder: Path):
    assert sum(path.parent.parent == folder for path in MOVEMENTS) >= 5
    tree = ET.parse(folder / robot_type.load(folder).model).getroot()  # noqa: S314 - our own file
    names = [element.get("class", "") for element in tree.iter("default")]
    names += [element.get("name", "") for kind in ("material", "texture") for element in tree.iter(kind)]
    assert [name for name in names if name and not name.startswith(folder.name)] == [], "robots share worlds"
    draw = runpy.run_path(str(ROBOTS / "draw.py"))
    assert (folder / "drawing.json").read_bytes() == draw["drawing"](folder), "run python robots/draw.py"


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_the_catalogue_lists_the_abilities_that_the_device_describes(folder: Path):
    kind = robot_type.load(folder)
    listed = robot_type_out(KnownType(kind, kind.version, {}, usable=True))
    context: Any = DeviceContext(
        robot_type=kind,
        controller=None,  # type: ignore[arg-type]
        observe=lambda: None,
        geometry=geometry.load(kind, folder),
        skills=_driver_class(kind),  # type: ignore[arg-type] # its class names the skills
        readings=None,  # type: ignore[arg-type]
        obstacle_map=lambda: None,
    )
    assert listed.actions == context.tasks()
    assert listed.capabilities == kind.capabilities


def test_movements_are_scripts_with_a_description():
    assert len(SHIPPED) >= 4
    for path in MOVEMENTS:
        source = path.read_text(encoding="utf-8")
        first_line = (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]
        assert first_line.endswith("."), path
        assert topics.is_id(path.stem), path
        assert len(source) <= 64_000, "the wire contract's longest script"
