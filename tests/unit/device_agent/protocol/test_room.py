"""A room's manifest: what it takes, and what it says of what it does not."""

from pathlib import Path

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room
from tests.harness.paths import ROOT

ROOMS = ROOT / "robots" / "rooms"

ROOM = """
room = "attic"
version = 1
label = "Attic"
[plan]
lower_m = [-2.0, -1.0]
upper_m = [2.0, 1.0]
height_m = 2.2
[[robots]]
name = "arm"
type = "ur5"
position_m = [1.0, 0.0, 0.7]
[[devices]]
name = "lamp"
kind = "lamp"
label = "Lamp"
driver = "mujoco"
streams = [{ name = "settings", rate_hz = 1.0 }]
controls = [{ name = "level", label = "Level", lower = 0.0, upper = 1.0 }]
[[zones]]
name = "bed"
label = "Bed"
lower_m = [0.0, 0.0, 0.0]
upper_m = [1.0, 1.0, 1.0]
[[people]]
name = "person"
path_m = [[0.0, 0.0], [1.0, 0.5]]
"""


def with_change(before: str, after: str) -> str:
    assert before in ROOM
    return ROOM.replace(before, after, 1)


@pytest.mark.parametrize("folder", [path.parent for path in ROOMS.glob("*/room.toml")], ids=lambda path: path.name)
def test_every_room_of_the_installation_is_read(folder: Path):
    found = room.load(folder)
    assert found.room == folder.name
    assert not found.model or (folder / found.model).is_file()
    assert (folder / "README.md").is_file()


def test_what_is_in_a_room_is_found_by_its_name():
    attic = room.parse(ROOM)
    assert attic.names == ("arm", "lamp")
    assert attic.robot("arm") == attic.robots[0]
    assert attic.device("lamp") == attic.devices[0]
    assert attic.robot("lamp") is None
    assert attic.device("arm") is None


def test_a_room_device_is_a_type_without_joints():
    kind = room.parse(ROOM).devices[0].robot_type()
    assert (kind.type, kind.kind, kind.joints, kind.driver) == ("lamp", "lamp", (), "mujoco")
    assert kind.streams[0].name == "settings"
    assert {"streams", "controls"} <= set(kind.capabilities)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("room = ", "Invalid value"),
        (with_change("height_m = 2.2", ""), "missing required field `height_m`"),
        (with_change("height_m = 2.2", "height_m = 0"), "height_m of the plan is 0.0; it must be above 0"),
        (with_change("lower_m = [-2.0", "lower_m = [3.0"), "plan: lower_m must be below upper_m"),
        (with_change('name = "lamp"', 'name = "arm"'), "robots and devices: the name 'arm' is used twice"),
        (with_change("position_m = [1.0", "position_m = [9.0"), "robot 'arm' is outside of the plan"),
        (with_change("position_m = [1.0, 0.0, 0.7]", "position_m = [1.0, 0.0, nan]"), "robot 'arm': all numbers must"),
        (with_change("rate_hz = 1.0", "rate_hz = 900.0"), "rate_hz of stream 'settings' of device 'lamp'"),
        (with_change("lower = 0.0", "lower = 2.0"), "control 'level' of device 'lamp': lower must be below upper"),
        (with_change("upper_m = [1.0, 1.0, 1.0]", "upper_m = [1.0, 1.0, 0.0]"), "zone 'bed': lower_m must be below"),
        (with_change("[1.0, 0.5]]", "[0.0, 0.0]]"), "path_m of person 'person' has the same corner twice in a row"),
        (with_change("[1.0, 0.5]]", "[7.0, 0.5]]"), "person 'person' is outside of the plan"),
        (ROOM + "speed_m_s = 0.0", "speed_m_s of person 'person' is 0.0"),
        (ROOM + "pause_s = -1.0", "pause_s of person 'person' must be at least 0"),
        (ROOM + "[climate]\nheater_w = -1.0", "heater_w of climate must be at least 0"),
        (ROOM + "[climate]\ncapacity_j_k = 0.0", "capacity_j_k of climate is 0.0"),
        (ROOM + "[climate]\noutside_c = inf", "climate: all numbers must be finite"),
        (ROOM + "[start]\nlamp = nan", "start: all numbers must be finite"),
        (ROOM + "[colour]\n", "unknown field `colour`"),
    ],
)
def test_what_is_wrong_is_said(text: str, says: str):
    with pytest.raises(ProtocolError, match=r"\A.*" + says.replace("(", r"\(")):
        room.parse(text)


def test_a_room_must_have_its_folders_name(tmp_path: Path):
    (tmp_path / "room.toml").write_text(ROOM)
    with pytest.raises(ProtocolError, match=f"room 'attic' must equal the folder's name '{tmp_path.name}'"):
        room.load(tmp_path)


def test_a_room_that_is_no_text_names_the_file(tmp_path: Path):
    (tmp_path / "room.toml").write_bytes(b"label = '\xff'")
    with pytest.raises(ProtocolError, match=r"room\.toml: .*utf-8"):
        room.load(tmp_path)


def test_a_room_that_is_not_there_names_the_file(tmp_path: Path):
    with pytest.raises(ProtocolError, match=r"room\.toml"):
        room.load(tmp_path / "nowhere")
