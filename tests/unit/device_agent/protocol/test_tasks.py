"""A manifest of objects and tasks is read, or rejected with the field that is wrong."""

from pathlib import Path

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import tasks
from tests.harness.paths import ROBOTS

TEXT = (ROBOTS / "ur5_gripper" / "tasks.toml").read_text(encoding="utf-8")


def test_the_shipped_manifest_is_valid() -> None:
    manifest = tasks.parse(TEXT)
    assert [each.name for each in manifest.objects] == ["red_cube", "blue_cube", "yellow_block", "peg", "hole_block"]
    assert manifest.region("green_tray").upper_m[2] == 0.06
    assert (manifest.joints[0].name, manifest.region("hole").part) == ("drawer", "hole_block")
    assert manifest.task("open_drawer").success.at_least == 0.15
    task = manifest.task("red_cube_in_green_tray")
    assert (task.movement, task.success.object, task.success.rest_s) == ("pick_and_place", "red_cube", 1.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rest_s = 1.0", "rest_s = 0.0", r"task 'red_cube_in_green_tray': success.rest_s is 0.0; it must be above 0"),
        ("lifted_m = 0.05", "lifted_m = nan", "success.lifted_m is nan"),
        ("time_limit_s = 60.0", "time_limit_s = -1.0", "time_limit_s is -1.0"),
        ('region = "green_tray"', 'region = "red_tray"', "no region 'red_tray'; there are: green_tray"),
        ('object = "red_cube"\nregion', 'object = "cup"\nregion', "no object 'cup'; there are: red_cube, blue_cube"),
        ("upper_m = [-0.34, 0.10]", "upper_m = [-0.34, -0.20]", "object 'red_cube': lower_m must not be above upper_m"),
        ("mass_kg = [0.05, 0.8]", "mass_kg = [0.8, 0.05]", "object 'red_cube': mass_kg is a lowest and a highest"),
        ("mass_kg = [0.05, 0.8]", "mass_kg = [0.0, 0.8]", "object 'red_cube': mass_kg is 0.0; it must be above 0"),
        ("friction = [0.4, 1.0]", "friction = [0.4, inf]", "friction is a lowest and a highest value, both finite"),
        ("size_scale = [0.85, 1.15]", "size_scale = [0.0, 1.15]", "object 'red_cube': size_scale is 0.0; it must be"),
        ("light = [0.6, 1.2]", "light = [1.2, 0.6]", "light is a lowest and a highest value"),
        (
            "light = ",
            'scene = "../other.xml"\nlight = ',
            "scene is '../other.xml'; it must be the name of an .xml file",
        ),
        ("light = ", 'scene = "other"\nlight = ', "scene is 'other'; it must be the name of an .xml file"),
        ('part = "hole_block"', 'part = "nut"', "region 'hole': no object or joint 'nut'; there are: .*drawer"),
        ('joint = "drawer"', 'joint = "door"', "task 'open_drawer': no joint 'door'; there are: drawer"),
        ('joint = "drawer"', 'joint = "drawer"\nobject = "peg"', "success has either an object or a joint"),
        ('joint = "drawer"\n', "", "success has either an object or a joint"),
        ("at_least = 0.15", "at_least = nan", "success.at_least must be a finite position"),
        ("at_least = 0.15\n", "", "success.at_least must be a finite position"),
        ("lifted_m = 0.05\n", "", "success.lifted_m is missing"),
        ('name = "drawer"', 'name = "peg"', "two objects or joints have the same name"),
        ("position = [0.0, 0.02]", "position = [0.02, 0.0]", "joint 'drawer': position is a lowest and a highest"),
        ("damping = [2.0, 20.0]", "damping = [-2.0, 20.0]", "joint 'drawer': friction and damping must not be neg"),
        ("friction = [0.4, 1.0]", "friction = 0.4", "Expected `array`"),
        ("upper_m = [-0.41, 0.34, 0.06]", "upper_m = [-0.41, 0.34, 0.0]", "region 'green_tray': lower_m must be below"),
        ('name = "blue_cube"', 'name = "red_cube"', "two objects or joints have the same name"),
        ('name = "blue_cube_in_green_tray"', 'name = "red_cube_in_green_tray"', "two tasks have the same name"),
        ("rest_s = 1.0", "rest_s = 1.0\nscore = 1", "unknown field `score`"),
        ("light = ", "gap_m = -1.0\nlight = ", "gap_m is -1.0"),
        ("[[objects]]", "[[objects", "at line"),
    ],
)
def test_a_wrong_field_is_named(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(ProtocolError, match=message):
        tasks.parse(TEXT.replace(old, new, 1))


def test_an_unknown_task_lists_the_known_ones() -> None:
    with pytest.raises(ProtocolError, match=r"no task 'juggle'; there are: red_cube_in_green_tray, blue_cube"):
        tasks.parse(TEXT).task("juggle")


def test_an_error_names_the_file_and_a_scene_may_have_none(tmp_path: Path) -> None:
    assert tasks.load(tmp_path / "scene.xml") is None
    (tmp_path / "tasks.toml").write_text(TEXT.replace("rest_s = 1.0", "rest_s = 0.0"), encoding="utf-8")
    with pytest.raises(ProtocolError, match=r"tasks\.toml: task 'red_cube"):
        tasks.load(tmp_path / "scene.xml")
