"""Devices that belong to a room: entries of ``agent.toml`` and their robot types."""

import shutil
from pathlib import Path

import pytest

from device_agent import bootstrap, sensors
from device_agent.__main__ import main
from device_agent.config import catalogue
from device_agent.config.agent_config import AgentConfig, DeviceEntry
from device_agent.config.errors import ConfigError
from tests.harness.paths import ROBOTS

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


# ------------------------------------------------------------ device types

CAMERA = DeviceEntry(name="door", type="camera", driver="mjpeg", label="Front door", options={"url": "http://door/"})


def test_a_device_type_needs_no_room() -> None:
    kind = catalogue.type_of(CAMERA)
    assert (kind.type, kind.kind, kind.label, kind.capabilities) == (
        "camera", "camera", "Front door", ("cameras", "captures"),
    )  # fmt: skip
    device = bootstrap.create_room_device(CAMERA, {})
    assert device is not None
    assert (device.manifest.name, device.manifest.driver, device.cameras) == ("door", "mjpeg", ("colour",))
    assert not device.simulated


def test_a_device_type_is_registered_as_such() -> None:
    config = AgentConfig(server="http://127.0.0.1:9", name="room", devices=(CAMERA,))
    assert catalogue.enrolled_devices(config) == [
        {"name": "door", "kind": "camera", "robot_type": "camera", "label": "Front door"}
    ]


def test_a_robot_type_of_the_same_name_takes_precedence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROBOTS / "ur5", tmp_path / "camera")
    manifest = tmp_path / "camera" / "robot.toml"
    manifest.write_text(manifest.read_text().replace('type = "ur5"', 'type = "camera"', 1))
    monkeypatch.setenv(catalogue.ROBOTS_PATH, str(tmp_path))
    assert len(catalogue.type_of(CAMERA).joints) == 6
    assert catalogue.room_device_of(CAMERA) is None


@pytest.mark.parametrize("folder", sorted(path.parent for path in ROBOTS.glob("devices/*/device.toml")), ids=str)
def test_shipped_device_types_are_valid(folder: Path) -> None:
    device = catalogue.DEVICES.load(folder.name)
    assert device.kind == folder.name
    assert device.driver in sensors.names()
    assert {watch.source for watch in device.watch} >= {camera.name for camera in device.cameras}


def test_a_wrong_device_type_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "devices" / "probe"
    folder.mkdir(parents=True)
    (folder / "device.toml").write_text('name = "probe"\nkind = "probe"\nlabel = "Probe"\ndriver = "x"\ncolour = 1\n')
    monkeypatch.setenv(catalogue.ROBOTS_PATH, str(tmp_path))
    with pytest.raises(ConfigError, match=r"probe/device\.toml: .*colour"):
        catalogue.type_of(DeviceEntry(name="probe", type="probe"))


def test_the_driver_of_a_room_device_is_checked_at_enrollment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["enroll", "--home", str(tmp_path), "--server", "http://127.0.0.1:9", "--device", "door=camera:lens"]
    assert main(arguments) == 1
    assert "no sensor driver 'lens'; there are: mjpeg, " in capsys.readouterr().err
