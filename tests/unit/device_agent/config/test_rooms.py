"""Devices that stand in a room: how ``agent.toml`` names them, and what the agent makes of that."""

from pathlib import Path

import pytest

from device_agent import bootstrap
from device_agent.__main__ import main
from device_agent.cli.doctor import devices
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore

ARM = DeviceEntry(name="ur5", type="ur5", room="lab")


def test_a_room_gives_an_entry_for_each_thing_in_it():
    entries = catalogue.entries_of("lab")
    assert [entry.name for entry in entries] == list(catalogue.ROOMS.load("lab").names)
    assert all(entry.room == "lab" and entry.label for entry in entries)
    for entry in entries:
        assert catalogue.type_of(entry).type == entry.type


def test_the_room_of_a_device_is_kept_in_its_file(tmp_path: Path):
    store = IdentityStore(tmp_path)
    AgentConfig(server="http://x", name="x", devices=(ARM,)).save(store.folder)
    assert AgentConfig.load(store.folder).devices == (ARM,)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        (DeviceEntry(name="ur5", type="ur5", room="attic"), "no room 'attic'; there are: lab"),
        (DeviceEntry(name="ur6", type="ur5", room="lab"), "room 'lab' has no 'ur6'; it has: ur5, "),
        (DeviceEntry(name="ur5", type="hanson", room="lab"), "'ur5' of room 'lab' is a ur5, not a hanson"),
    ],
)
def test_what_the_room_does_not_have_is_named_with_what_it_has(entry: DeviceEntry, says: str):
    with pytest.raises(ConfigError, match=says):
        catalogue.type_of(entry)


def test_an_unknown_room_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ["enroll", "--home", str(tmp_path), "--server", "http://127.0.0.1:9", "--room", "attic"]
    assert main(arguments) == 1
    assert "no room 'attic'; there are: lab. Name the folder that holds yours" in capsys.readouterr().err


def test_in_its_room_the_arm_keeps_clear_of_what_stands_there():
    kind = catalogue.type_of(ARM)
    shape = bootstrap.geometry_of(ARM, kind)
    assert shape is not None
    home = [kind.home_rad[joint.name] for joint in kind.joints]
    down = list(home)
    down[kind.joints.index(next(joint for joint in kind.joints if joint.name == "shoulder_lift"))] = -0.6
    onto_table = shape.sweep([home, down])
    assert onto_table.clearance is not None
    assert "table_top" in onto_table.clearance.text
    assert shape.clearance(home).room_m > 0


def test_the_doctor_looks_at_a_rooms_device_by_its_own_driver():
    (good,) = devices.device(DeviceEntry(name="door", type="door", room="lab"))
    assert (good.level, good.message) == ("ok", "door, driver 'mujoco': simulated; its room has what it needs")
    (wrong,) = devices.device(DeviceEntry(name="lidar", type="lidar", room="lab", options={"site": "nowhere"}))
    assert wrong.level == "problem"
    assert "no site 'nowhere'; it has: " in wrong.message
    (unknown,) = devices.device(DeviceEntry(name="lidar", type="lidar", room="lab", options={"range": 3}))
    assert "no option 'range'" in unknown.message
