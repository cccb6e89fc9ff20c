"""A room's manifest is read, or rejected with the field that is wrong."""

from pathlib import Path

import pytest

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import room
from tests.harness.paths import ROBOTS

ROOMS = ROBOTS / "rooms"
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
def test_every_room_of_the_installation_is_valid(folder: Path):
    loaded = room.load(folder)
    assert loaded.room == folder.name
    assert not loaded.model or (folder / loaded.model).is_file()
    assert (folder / "README.md").is_file()


def test_robots_and_devices_are_found_by_name():
    attic = room.parse(ROOM)
    assert attic.names == ("arm", "lamp")
    assert (attic.robot("arm"), attic.robot("lamp")) == (attic.robots[0], None)
    assert (attic.device("lamp"), attic.device("arm")) == (attic.devices[0], None)


def test_a_room_device_is_a_type_without_joints():
    kind = room.parse(ROOM).devices[0].robot_type()
    assert (kind.type, kind.kind, kind.joints, kind.driver) == ("lamp", "lamp", (), "mujoco")
    assert kind.streams[0].name == "settings"
    assert {"streams", "controls"} <= set(kind.capabilities)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("room = ", "Invalid value"),
        (with_change("height_m = 2.2", ""), "missing required field `height_m`"),
        (with_change("height_m = 2.2", "height_m = 0"), "height_m of the plan is 0.0; it must be above 0"),
        (with_change("lower_m = [-2.0", "lower_m = [3.0"), "plan: lower_m must be below upper_m"),
        (with_change('name = "lamp"', 'name = "arm"'), "robots and devices: the name 'arm' is used twice"),
        (with_change("position_m = [1.0", "position_m = [9.0"), "robot 'arm' is outside of the plan"),
        (with_change("position_m = [1.0, 0.0, 0.7]", "position_m = [1.0, 0.0, nan]"), "robot 'arm': all numbers must"),
        (with_change("rate_hz = 1.0", "rate_hz = 900.0"), "rate_hz of stream 'settings' of device 'lamp'"),
        (
            with_change("streams = [", 'cameras = [{ name = "view", rate_hz = 1.0, kind = "thermal" }]\nstreams = ['),
            "kind 'thermal' of camera 'view' of device 'lamp' is unknown; use one of: colour, depth, scan, people",
        ),
        (
            with_change("streams = [", 'cameras = [{ name = "view", rate_hz = 1.0, kind = 2 }]\nstreams = ['),
            "Expected `str`, got `int`",
        ),
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
def test_mistakes_are_named(text: str, message: str):
    with pytest.raises(ProtocolError, match=r"\A.*" + message.replace("(", r"\(")):
        room.parse(text)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ROOM.encode(), "room 'attic' must equal the folder's name 'loft'"),
        (b"label = '\xff'", r"room\.toml: .*utf-8"),
        (None, r"room\.toml"),
    ],
)
def test_an_unusable_file_is_named(tmp_path: Path, content: bytes | None, message: str):
    folder = tmp_path / "loft"
    folder.mkdir()
    if content is not None:
        (folder / "room.toml").write_bytes(content)
    with pytest.raises(ProtocolError, match=message):
        room.load(folder)
