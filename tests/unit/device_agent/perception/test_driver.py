"""The perception driver."""

import json
import math
import time

import pytest

from device_agent import sensors
from device_agent.ports.sensor import RoomDriver, SensorError, Surroundings
from device_agent.protocol import Stream
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.perception import PerceptionDriver, create
from tests.unit.device_agent.perception.playground import KINDS, Playground, survey

ROOM = """
room = "toy"
version = 1
label = "Toy"
[plan]
lower_m = [-3.0, -2.5]
upper_m = [3.0, 2.5]
height_m = 2.7
[[robots]]
name = "arm"
type = "ur5"
position_m = [1.9, 1.6, 0.75]
[[zones]]
name = "west"
label = "West"
lower_m = [-3.0, -2.5, 0.0]
upper_m = [0.0, 2.5, 2.7]
"""


class FakeSensor:
    """A sensor of the playground with the real clock."""

    simulated = True

    def __init__(self, ground, sense):
        self.ground = ground
        self.sense = sense
        self.broken = False

    def raw(self):
        if self.broken:
            raise SensorError("the lens is dirty")
        self.ground.time_s = time.monotonic()
        return getattr(self.ground, self.sense)()

    def read(self, stream):
        assert stream == "light"
        return {"light_lux": 321.0}


def options(**more):
    kinds = [
        {name: getattr(kind, name) for name in ("name", "lowest_m", "highest_m", "radius_m", "several")}
        for kind in KINDS
    ]
    mounts = [{"name": "arm", "lowest_m": 0.78, "highest_m": 0.95, "radius_m": 0.05, "reach_m": 1}]
    return {"lidars": ["lidar"], "cameras": ["depth"], "kinds": kinds, "mounts": mounts, "look_hz": 20, **more}


def device(**more):
    return RoomDeviceManifest(
        name="perception",
        kind="perception",
        label="What the room knows",
        driver="perception",
        streams=(Stream(name="positions", rate_hz=5.0),),
        options=options(**more),
    )


@pytest.fixture
def folder(tmp_path):
    found = tmp_path / "toy"
    found.mkdir()
    (found / "room.toml").write_text(ROOM)
    (found / "survey.npz").write_bytes(survey().to_bytes())
    return found


@pytest.fixture
def neighbours():
    ground = Playground(1)
    return {
        "lidar": FakeSensor(ground, "scan"),
        "depth": FakeSensor(ground, "depth"),
        "light": FakeSensor(ground, "scan"),
    }


@pytest.fixture
def driver(folder, neighbours):
    made = create(device(survey="survey.npz", light="light"), folder, Surroundings(neighbours=neighbours))
    made.connect()
    yield made
    made.close()


def until(driver, stream, holds, patience_s=60):
    deadline = time.monotonic() + patience_s
    while not holds(found := driver.read(stream)):
        assert time.monotonic() < deadline, found
        time.sleep(0.02)
    return found


def test_streams_report_positions(driver, neighbours):
    ground = neighbours["lidar"].ground
    found = until(driver, "positions", lambda found: {"x_m.person", "x_m.nao", "x_m.qbo"} <= set(found))
    for name, one in ground.walkers.items():
        assert math.dist((found[f"x_m.{name}"], found[f"y_m.{name}"]), (one.x_m, one.y_m)) < 0.2
        assert found[f"age_s.{name}"] < 5
    assert all(isinstance(value, float) and math.isfinite(value) for value in found.values())
    found = until(driver, "positions", lambda found: "x_m.arm" in found)
    assert math.dist((found["x_m.arm"], found["y_m.arm"]), (1.95, 1.5)) < 0.15
    assert until(driver, "presence", lambda found: found["people.west"] == 1.0)["present.west"] is True
    assert driver.read("light") == {"light_lux": 321.0}


def test_it_is_a_room_driver_found_by_name(driver):
    assert isinstance(driver, RoomDriver)
    assert sensors.load("perception") is create
    assert driver.simulated
    assert driver.raw() is None


def test_captures_return_the_grid(driver):
    until(driver, "positions", lambda found: "x_m.qbo" in found)
    picture = driver.capture("occupancy")
    assert (picture.media_type, picture.content[:8]) == ("image/png", b"\x89PNG\r\n\x1a\n")
    found = json.loads(driver.capture("map").content)
    assert (len(found["taken_percent"]), len(found["taken_percent"][0])) == tuple(found["shape"])
    assert "x_m.qbo" in found["places"]
    assert driver.grid.blocked(0.2).at(0.9, -2.2)


def test_unknown_names_are_rejected_with_the_valid_ones(driver):
    with pytest.raises(SensorError, match="positions, presence, light"):
        driver.read("smell")
    with pytest.raises(SensorError, match="occupancy, map, survey"):
        driver.capture("smell")
    with pytest.raises(SensorError, match="no control 'smell'"):
        driver.set("smell", 1.0)


def test_it_fails_only_if_all_sensors_fail(driver, neighbours, monkeypatch):
    until(driver, "positions", lambda found: "x_m.qbo" in found)
    neighbours["depth"].broken = True
    driver.read("positions")
    monkeypatch.setattr("device_agent.sensors.perception.driver.SILENT_S", 0.2)
    neighbours["lidar"].broken = True
    assert "the lens is dirty" in error_text(driver, blind=True)
    neighbours["lidar"].broken = False
    assert not error_text(driver, blind=False)


def error_text(driver, *, blind, patience_s=60):
    """Wait until reading fails (``blind``) or succeeds; returns the error message."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            driver.read("positions")
            message = ""
        except SensorError as error:
            message = str(error)
        if bool(message) == blind:
            return message
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_it_can_be_reopened(driver):
    driver.close()
    driver.close()
    with pytest.raises(SensorError, match="not connected"):
        driver.read("positions")
    driver.connect()
    driver.connect()
    driver.read("presence")


def test_a_survey_can_be_captured(driver, monkeypatch):
    monkeypatch.setattr("device_agent.sensors.perception.driver.SURVEY_EVERY_S", 0.0)
    assert driver.capture("survey").content[:2] == b"PK"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"lenses": []}, "lenses.*lidars, cameras"),
        ({"look_hz": 0}, "look_hz"),
        ({"kinds": [{"name": "x", "lowest_m": 2, "highest_m": 1, "radius_m": 0}]}, "heights must increase"),
    ],
)
def test_invalid_options_are_rejected(folder, neighbours, more, message):
    with pytest.raises(SensorError, match=message):
        PerceptionDriver(device(**more), folder, neighbours)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"lidars": ["radar"]}, "'radar'; this agent's devices: depth, lidar, light"),
        ({"survey": "none.npz"}, "capture 'survey'"),
        ({"mounts": [{"name": "x", "lowest_m": 0, "highest_m": 1, "radius_m": 0, "reach_m": 1}]}, "the room has: arm"),
    ],
)
def test_connect_reports_mismatches_with_the_room(folder, neighbours, more, message):
    with pytest.raises(SensorError, match=message):
        PerceptionDriver(device(**more), folder, neighbours).connect()
