"""The perception driver."""

import json
import math
import time

import pytest

from device_agent import sensors
from device_agent.ports.sensor import Reducible, RoomDriver, SensorError, Surroundings
from device_agent.protocol import Stream
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.perception import PerceptionDriver, create
from tests.unit.device_agent.perception.playground import KINDS, SyntheticRoom, survey

pytestmark = pytest.mark.slow
ROOM = """
room = "synthetic"
version = 1
label = "Synthetic room"
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
    """A sensor of the synthetic room with the real clock."""

    simulated = True

    def __init__(self, scene, method):
        self.scene = scene
        self.method = method
        self.broken = False

    def raw(self):
        if self.broken:
            raise SensorError("the lens is dirty")
        self.scene.time_s = time.monotonic()
        return getattr(self.scene, self.method)()

    def read(self, _stream):
        return {"light_lux": 321.0}


MOUNT = {"name": "arm", "lowest_m": 0.78, "highest_m": 0.95, "radius_m": 0.05, "reach_m": 1}
FIELDS = ("name", "lowest_m", "highest_m", "radius_m", "several")


def options(**changes):
    kinds = [{name: getattr(kind, name) for name in FIELDS} for kind in KINDS]
    return {"lidars": ["lidar"], "cameras": ["depth"], "kinds": kinds, "mounts": [MOUNT], "look_hz": 20, **changes}


def device(**changes):
    return RoomDeviceManifest(
        name="perception",
        kind="perception",
        label="Room perception",
        driver="perception",
        streams=(Stream(name="positions", rate_hz=5.0),),
        options=options(**changes),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic", numbered=False)
    (folder / "room.toml").write_text(ROOM)
    (folder / "survey.npz").write_bytes(survey().to_bytes())
    return folder


@pytest.fixture
def neighbours():
    scene = SyntheticRoom(1)
    return {name: FakeSensor(scene, method) for name, method in (("lidar", "scan"), ("depth", "depth"), ("light", ""))}


@pytest.fixture
def driver(folder, neighbours):
    driver = create(device(survey="survey.npz", light="light"), folder, Surroundings(neighbours=neighbours))
    driver.connect()
    yield driver
    driver.close()


def until(read, accepted, timeout_s=60):
    """Read until the result is accepted, and return it."""
    deadline = time.monotonic() + timeout_s
    while not accepted(result := read()):
        assert time.monotonic() < deadline, result
        time.sleep(0.02)
    return result


def positions(driver):
    """The values, or the error message."""
    try:
        return driver.read("positions")
    except SensorError as error:
        return str(error)


def located(driver, *names):
    """The values once all these objects are located."""
    return until(lambda: positions(driver), lambda values: {f"x_m.{name}" for name in names} <= set(values))


def test_streams_report_positions(driver, neighbours):
    assert isinstance(driver, RoomDriver)
    assert sensors.load("perception") is create
    assert driver.simulated
    assert driver.raw() is None
    scene = neighbours["lidar"].scene
    values = located(driver, "person", "nao", "qbo")
    for name, walker in scene.walkers.items():
        assert math.dist((values[f"x_m.{name}"], values[f"y_m.{name}"]), (walker.x_m, walker.y_m)) < 0.2
        assert values[f"age_s.{name}"] < 5
    assert all(isinstance(value, float) and math.isfinite(value) for value in values.values())
    values = located(driver, "arm")
    assert math.dist((values["x_m.arm"], values["y_m.arm"]), (1.95, 1.5)) < 0.15
    presence = until(lambda: driver.read("presence"), lambda values: values["people.west"] == 1.0)
    assert presence["present.west"] is True
    assert driver.read("light") == {"light_lux": 321.0}


def test_captures_return_the_grid_and_a_survey(driver, monkeypatch):
    located(driver, "qbo")
    picture = driver.capture("occupancy")
    assert (picture.media_type, picture.content[:8]) == ("image/png", b"\x89PNG\r\n\x1a\n")
    grid = json.loads(driver.capture("map").content)
    assert (len(grid["taken_percent"]), len(grid["taken_percent"][0])) == tuple(grid["shape"])
    assert "x_m.qbo" in grid["places"]
    assert driver.grid.blocked(0.2).at(0.9, -2.2)
    monkeypatch.setattr("device_agent.sensors.perception.driver.SURVEY_EVERY_S", 0.0)
    assert driver.capture("survey").content[:2] == b"PK"


def test_it_fails_only_if_all_sensors_fail(driver, neighbours, monkeypatch):
    located(driver, "qbo")
    neighbours["depth"].broken = True
    driver.read("positions")
    monkeypatch.setattr("device_agent.sensors.perception.driver.SILENT_S", 0.2)
    neighbours["lidar"].broken = True
    assert "the lens is dirty" in until(lambda: positions(driver), lambda result: isinstance(result, str))
    neighbours["lidar"].broken = False
    until(lambda: positions(driver), lambda result: not isinstance(result, str))


def test_an_overloaded_agent_samples_the_sensors_less_often(driver):
    reducible: RoomDriver = driver
    assert isinstance(reducible, Reducible)
    usual_s = driver._period_s
    driver.reduce(0.5)
    assert driver._period_s == 2 * usual_s


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lenses": []}, "lenses.*lidars, cameras"),
        ({"look_hz": 0}, "look_hz"),
        ({"kinds": [{"name": "x", "lowest_m": 2, "highest_m": 1, "radius_m": 0}]}, "heights must increase"),
    ],
)
def test_invalid_options_are_rejected(folder, neighbours, changes, message):
    with pytest.raises(SensorError, match=message):
        PerceptionDriver(device(**changes), folder, neighbours)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lidars": ["radar"]}, "'radar'; this agent's devices: depth, lidar, light"),
        ({"survey": "none.npz"}, "capture 'survey'"),
        ({"mounts": [MOUNT | {"name": "x"}]}, "the room has: arm"),
    ],
)
def test_connect_reports_mismatches_with_the_room(folder, neighbours, changes, message):
    with pytest.raises(SensorError, match=message):
        PerceptionDriver(device(**changes), folder, neighbours).connect()
