"""Importing MuJoCo models as robot types."""

from pathlib import Path

import mujoco
import pytest

from device_agent import geometry
from device_agent.__main__ import main
from device_agent.drivers import load as load_driver
from device_agent.protocol.manifests import robot_type
from device_agent.simulation.mjcf.import_model import ImportModelError, import_model

ARM = """
<mujoco model="arm"><compiler angle="radian" autolimits="true"/>
<default><default class="two"><position kp="100" kv="10"/></default></default>
<worldbody>
  <body name="link0">
    <geom type="cylinder" size=".05 .05" pos="0 0 .05"/>
    <body name="link1" pos="0 0 .12">
      <joint name="turn" axis="0 0 1" range="-2 2"/>
      <geom type="capsule" size=".03" fromto="0 0 .03 0 0 .3"/>
      <body name="link2" pos="0 0 .36">
        <joint name="bend" axis="0 1 0" damping="1"/>
        <geom type="capsule" size=".02" fromto=".05 0 0 .3 0 0"/>
        <body name="finger" pos=".35 .02 0">
          <joint name="finger" type="slide" axis="0 1 0" range="0 .04"/><geom size=".01"/>
        </body>
        <body name="thumb" pos=".35 -.02 0">
          <joint name="thumb" type="slide" axis="0 -1 0" range="0 .04"/><geom size=".01"/>
        </body>
      </body>
    </body>
  </body>
</worldbody>
<equality><joint joint1="thumb" joint2="finger"/></equality>
<actuator>
  <position name="act_turn" class="two" joint="turn" ctrlrange="-1.5 2.5" forcerange="-20 30"/>
  <general name="act_bend" joint="bend" gainprm="200" biastype="affine" biasprm="0 -200 -20"/>
  <position name="act_finger" class="two" joint="finger" ctrlrange="0 .04"/>
</actuator>
</mujoco>
"""
SCENE = """
<mujoco model="arm scene"><include file="arm.xml"/>
<worldbody>
  <light pos="0 0 3"/><geom name="floor" type="plane" size="2 2 .1"/>
  <body name="ball" pos="1 0 1"><freejoint/><geom size=".05"/></body>
</worldbody>
<keyframe><key name="home" qpos="0.5 -0.4 .01 .01 1 0 1 1 0 0 0" ctrl="0.5 -0.4 .01"/></keyframe>
</mujoco>
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def test_missing_figures_are_guessed_and_marked(scene: Path, tmp_path: Path) -> None:
    folder = import_model(scene, "arm", tmp_path / "types")
    kind = robot_type.load(folder)
    turn, bend, finger = kind.joints
    assert [joint.name for joint in kind.joints] == ["turn", "bend", "finger"]
    assert (turn.lower_rad, turn.upper_rad, turn.max_effort_nm) == (-1.5, 2.0, 20.0)
    assert (bend.lower_rad, bend.upper_rad) == pytest.approx((-3.1416, 3.1416), abs=1e-4)
    assert bend.max_effort_nm >= 1.0
    assert finger.max_velocity_rad_s < turn.max_velocity_rad_s
    assert kind.home_rad == pytest.approx({"turn": 0.5, "bend": -0.4, "finger": 0.01})
    manifest = (folder / "robot.toml").read_text()
    assert "max_effort_nm = 20.0\n" in manifest
    assert manifest.count("# guessed") == 1 + 3 * 3 + 2 + 2
    assert "bend" in (folder / "README.md").read_text()


def test_only_the_robot_is_imported(scene: Path, tmp_path: Path) -> None:
    folder = import_model(scene, "arm", tmp_path / "types")
    alone = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    assert [alone.body(index).name for index in range(1, alone.nbody)] == ["link0", "link1", "link2", "finger", "thumb"]
    assert alone.nlight == 0
    kind = robot_type.load(folder)
    shape = geometry.load(kind, folder)
    assert shape is not None
    assert set(shape.poses([0.0, 0.0, 0.0])) == {"finger"}
    driver = load_driver("mujoco")(kind, folder, {}, "arm")
    driver.connect()
    assert driver.observe().position_rad == pytest.approx((0.5, -0.4, 0.01), abs=0.1)
    driver.close()


def test_meshes_are_copied(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "hand.obj").write_text(corners)
    text = ARM.replace("<compiler angle", '<compiler meshdir="parts" angle').replace(
        "<worldbody>", '<asset><mesh name="hand" file="hand.obj" scale=".1 .1 .1"/></asset><worldbody>', 1
    )
    (tmp_path / "arm.xml").write_text(text.replace('<geom size=".01"/>', '<geom type="mesh" mesh="hand"/>', 1))
    folder = import_model(tmp_path / "arm.xml", "arm", tmp_path / "types")
    assert (folder / "assets" / "hand.obj").read_text() == corners
    assert mujoco.MjModel.from_xml_path(str(folder / "scene.xml")).nmesh == 1


@pytest.mark.parametrize(
    ("actuators", "message"),
    [
        ('<motor name="a" joint="turn"/>', "a is not a position servo.*--without a"),
        ('<position name="a" joint="turn" gear="2"/>', "a has a gear of 2"),
        ("", "no actuators"),
        ('<position joint="turn"/><position joint="turn"/>', "two actuators move the same joint"),
        ('<position joint="turn" ctrlrange="3 4"/>', "'turn' and its actuator have disjoint ranges"),
        ('<position name="a" tendon="thread"/>', "a does not act on a joint"),
    ],
)
def test_unsupported_actuators_are_rejected(actuators: str, message: str, tmp_path: Path) -> None:
    thread = '<tendon><fixed name="thread"><joint joint="turn" coef="1"/></fixed></tendon>'
    head, _, tail = ARM.partition("<actuator>")
    tail = tail.partition("</actuator>")[2]
    (tmp_path / "arm.xml").write_text(f"{head}{thread}<actuator>{actuators}</actuator>{tail}")
    with pytest.raises(ImportModelError, match=message):
        import_model(tmp_path / "arm.xml", "arm", tmp_path / "types")
    assert not (tmp_path / "types" / "arm").exists()


def test_an_actuator_can_be_left_out(scene: Path, tmp_path: Path) -> None:
    folder = import_model(scene, "arm", tmp_path / "types", without=["act_bend"])
    assert [joint.name for joint in robot_type.load(folder).joints] == ["turn", "finger"]
    with pytest.raises(ImportModelError, match="no actuator 'x' to leave out; available: act_turn, act_bend, act_fin"):
        import_model(scene, "other", tmp_path / "types", without=["x"])


@pytest.mark.parametrize(
    ("source", "name", "why"),
    [
        ("nowhere.xml", "arm", "MuJoCo cannot read this model"),
        ("scene.xml", "invalid name", "not a valid robot type"),
        ("scene.xml", "types", "exists already"),
    ],
)
def test_unusable_files_are_reported(scene: Path, source: str, name: str, why: str) -> None:
    (scene.parent / "types").mkdir()
    with pytest.raises(ImportModelError, match=why):
        import_model(scene.parent / source, name, scene.parent)


def test_the_command_creates_a_type(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["import-model", str(scene), "--name", "arm", "--into", str(tmp_path / "types")]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert str(tmp_path / "types" / "arm") in output
    assert "TELESCOPE_ROBOTS_PATH" in output
    assert main(command) == 1
    assert "exists already" in capsys.readouterr().err
