"""Devices that belong to a room: entries of ``agent.toml`` and their robot types."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from device_agent import bootstrap
from device_agent.__main__ import main
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.protocol import Stream

ARM = DeviceEntry(name="ur5", type="ur5", room="lab")


def test_a_room_has_an_entry_for_each_robot_and_device() -> None:
    entries = catalogue.entries_of("lab")
    assert [entry.name for entry in entries] == list(catalogue.ROOMS.load("lab").names)
    assert all(entry.room == "lab" and entry.label for entry in entries)
    assert all(catalogue.type_of(entry).type == entry.type for entry in entries)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (DeviceEntry(name="ur5", type="ur5", room="attic"), "no room 'attic'; known: lab"),
        (DeviceEntry(name="ur6", type="ur5", room="lab"), "room 'lab' has no 'ur6'; known: ur5, "),
        (DeviceEntry(name="ur5", type="hanson", room="lab"), "'ur5' of room 'lab' is a ur5, not a hanson"),
    ],
)
def test_unknown_names_are_listed_with_the_known_ones(entry: DeviceEntry, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        catalogue.type_of(entry)


def test_unknown_room_is_one_line_of_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["enroll", "--home", str(tmp_path), "--server", "http://127.0.0.1:9", "--room", "attic"]
    assert main(arguments) == 1
    assert "no room 'attic'; known: lab. To add your own" in capsys.readouterr().err


@pytest.mark.slow
def test_furniture_of_the_room_limits_the_arm() -> None:
    kind = catalogue.type_of(ARM)
    geometry = bootstrap.load_geometry(ARM, kind)
    assert geometry is not None
    home, down = (
        [position_rad[joint.name] for joint in kind.joints]
        for position_rad in (kind.home_rad, kind.home_rad | {"shoulder_lift": -0.6})
    )
    path = geometry.sweep([home, down])
    assert path.clearance is not None
    assert "table_top" in path.clearance.text
    assert geometry.clearance(home).excess_m > 0


THERMOMETER = DeviceEntry(
    name="air", type="thermometer", driver="modbus", streams=(Stream(name="air", rate_hz=1.0),), options={"host": "h"}
)


def test_a_described_device_is_a_room_device_of_its_type() -> None:
    kind, device = catalogue.type_of(THERMOMETER), catalogue.room_device_of(THERMOMETER)
    assert (kind.type, kind.kind, kind.driver, kind.joints) == ("thermometer", "thermometer", "modbus", ())
    assert device is not None
    assert (device.name, device.label, device.options) == ("air", "air", {"host": "h"})
    config = AgentConfig(server="http://s", name="n", devices=(THERMOMETER,))
    expected = {"name": "air", "kind": "thermometer", "robot_type": "thermometer", "label": "air"}
    assert catalogue.enrolled_devices(config) == [expected]
    assert not catalogue.downloadable(THERMOMETER)


def test_a_described_device_with_the_type_of_a_robot_is_rejected() -> None:
    with pytest.raises(ConfigError, match="'air' has streams or controls of its own, but 'ur5' is a robot type"):
        catalogue.type_of(replace(THERMOMETER, type="ur5"))


def test_another_enrollment_keeps_described_devices() -> None:
    previous = AgentConfig(server="http://s", name="n", devices=(THERMOMETER, ARM))
    enrolled = AgentConfig(server="http://s", name="n", devices=(replace(ARM, name="other"),))
    names = [device.name for device in enrolled.with_manual_settings(previous).devices]
    assert names == ["other", "air"]
