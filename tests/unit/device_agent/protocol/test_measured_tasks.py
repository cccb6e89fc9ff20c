"""Tasks over measurements of room devices are read, or rejected with the field that is wrong."""

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import tasks
from device_agent.protocol.manifests.measured_tasks import MeasuredTask
from tests.harness.paths import ROBOTS

TEXT = """
[[measured_tasks]]
name = "part_on_scale"
label = "Part onto the scale"
description = "Place the part on the scale."
movement = "feed_part"
time_limit_s = 120.0

[measured_tasks.success]
device = "scale"
stream = "weight"
field = "mass_kg"
above = 0.2
rest_s = 1.0
"""
SCENE = (ROBOTS / "ur5_gripper" / "tasks.toml").read_text(encoding="utf-8")


def test_a_real_robot_needs_no_objects() -> None:
    manifest = tasks.parse(TEXT)
    assert manifest.objects == ()
    task = manifest.find("part_on_scale")
    assert isinstance(task, MeasuredTask)
    assert (task.success.condition, task.success.stale_s) == ("mass_kg > 0.2", 2.0)


def test_both_kinds_of_tasks_are_found_by_name() -> None:
    manifest = tasks.parse(SCENE + TEXT)
    assert manifest.find("red_cube_in_green_tray") is manifest.task("red_cube_in_green_tray")
    assert manifest.find("part_on_scale") is manifest.measured_tasks[0]
    assert manifest.all_tasks[-1].name == "part_on_scale"
    with pytest.raises(ProtocolError, match=r"no task 'x'; there are: red_cube_in_green_tray, .*part_on_scale"):
        manifest.find("x")
    with pytest.raises(ProtocolError, match="no task 'x'; there are: none"):
        tasks.Tasks().find("x")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("above = 0.2", "", "exactly one of above, below and equals"),
        ("above = 0.2", "above = 0.2\nbelow = 0.1", "exactly one of above, below and equals"),
        ("above = 0.2", "above = nan", "with a finite number"),
        ("rest_s = 1.0", "rest_s = 0.0", r"task 'part_on_scale': success.rest_s is 0.0"),
        ("time_limit_s = 120.0", "time_limit_s = 0.0", r"task 'part_on_scale': time_limit_s is 0.0"),
        ("rest_s = 1.0", "rest_s = 1.0\nstale_s = 0.01", "stale_s"),
        ('field = "mass_kg"', 'field = "mass kg"', "field"),
        ("rest_s = 1.0", "rest_s = 1.0\nscore = 1", "unknown field `score`"),
    ],
)
def test_a_wrong_field_is_named(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(ProtocolError, match=message):
        tasks.parse(TEXT.replace(old, new, 1))


def test_a_name_is_unique_among_both_kinds() -> None:
    with pytest.raises(ProtocolError, match="two tasks have the same name"):
        tasks.parse(SCENE + TEXT.replace("part_on_scale", "red_cube_in_green_tray"))


def test_the_hash_identifies_the_text_whatever_its_line_ends() -> None:
    digest = tasks.parse(TEXT).sha256
    assert tasks.parse(TEXT.replace("\n", "\r\n")).sha256 == digest
    assert tasks.parse(TEXT.replace("0.2", "0.1")).sha256 != digest
    assert tasks.parse(f'sha256 = "{digest}"\n{TEXT}').sha256 != digest, "a manifest cannot name its own hash"
