"""A simulated room: shared world, walking person, air, light and sound."""

import gc
import math
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from device_agent.drivers import mujoco as driver
from device_agent.drivers.mujoco import World
from device_agent.ports.driver import DriverError, MobileDriver, Twist
from device_agent.protocol.manifests import robot_type, room
from device_agent.protocol.manifests.room import Room
from device_agent.simulation import world_registry
from device_agent.simulation.room.climate import Climate, water_g_m3
from device_agent.simulation.room.pedestrian import Pedestrian
from device_agent.simulation.room.sound import received_db
from tests.harness.paths import ROBOTS

pytestmark = pytest.mark.slow
LAB = ROBOTS / "rooms" / "lab"
MANIFEST = room.load(LAB)


def lab(manifest: Room = MANIFEST) -> World:
    types = {robot.type: robot_type.load(ROBOTS / robot.type) for robot in manifest.robots}
    world = world_registry.make(manifest, LAB, types)
    world.build()
    return world


EMPTY = msgspec.structs.replace(MANIFEST, robots=())
"""Without robots, five times faster."""


def warned(world: World) -> bool:
    return bool(world._data.warning.number.any())


def test_random_commands_are_finite_and_reproducible():
    def play() -> list[np.ndarray]:
        world, random, states = lab(), np.random.default_rng(5), []
        lower, upper = world.model.actuator_ctrlrange.T
        own = np.flatnonzero(["/" in world.model.actuator(index).name for index in range(world.model.nu)])
        home = world.snapshot().ctrl[own]
        for _ in range(100):
            target = np.clip(home + random.uniform(-0.1, 0.1, len(own)), lower[own], upper[own])
            world.command("all", own, target, ramp_s=0.04)
            states.append(world.step(20).qpos)
        assert not warned(world)
        assert np.isfinite(states).all()
        return states

    for first, second in zip(play(), play(), strict=True):
        assert np.array_equal(first, second)


def place_driver(world: World, name: str) -> driver.MujocoDriver:
    """The connected driver of one robot of the laboratory; the world is stepped manually."""
    robot = MANIFEST.robot(name)
    assert robot is not None
    kind = robot_type.load(ROBOTS / robot.type)
    placed = driver._driver_class(kind)(robot_type=kind, world=world, device=name, prefix=world_registry.prefix(name))
    placed._resolve(world.model)
    placed._connected = True
    return placed


def test_robots_start_at_their_manifest_poses():
    world = lab()
    position_rad = world.snapshot().position_rad
    for robot in MANIFEST.robots:
        x, y, _ = world.snapshot().body_position_m[place_driver(world, robot.name)._base]
        assert math.dist((x, y), robot.position_m[:2]) < 0.05
        for joint, home_rad in robot_type.load(ROBOTS / robot.type).home_rad.items():
            assert position_rad[f"{robot.name}/{joint}"] == pytest.approx(home_rad)


@pytest.mark.parametrize("name", ["nao", "qbo"])
def test_mobile_robots_move_in_the_room(name: str):
    robot = MANIFEST.robot(name)
    assert robot is not None
    world = lab()
    mobile = place_driver(world, name)
    assert isinstance(mobile, MobileDriver)
    kind = robot_type.load(ROBOTS / robot.type)
    height_m = world.snapshot().body_position_m[mobile._base][2]
    for _ in range(150):
        mobile.send([kind.home_rad[joint.name] for joint in kind.joints])
        mobile.drive(Twist(0.08, 0.0, 0.0))
        world.step(kind.period_ms // 2)
    x, y, z = world.snapshot().body_position_m[mobile._base]
    assert z == pytest.approx(height_m, abs=0.03)
    assert 0.1 < math.dist((x, y), robot.position_m[:2]) < 0.3
    towards = math.atan2(y - robot.position_m[1], x - robot.position_m[0])
    assert abs(math.remainder(towards - robot.yaw_rad, 2 * math.pi)) < 0.3
    assert not warned(world)


def test_devices_of_a_room_share_a_world():
    first, second = world_registry.get_world(LAB), world_registry.get_world(LAB)
    assert first is second
    first.set_quantities({"mark": 1.0})
    del first, second
    gc.collect()
    assert "mark" not in world_registry.get_world(LAB).quantities


def test_a_driver_uses_the_robot_of_its_name():
    kind = robot_type.load(ROBOTS / "ur5")
    arm = driver.create(kind, ROBOTS / "ur5", {"room": str(LAB)}, "ur5")
    arm.connect()
    try:
        home_rad = [kind.home_rad[joint.name] for joint in kind.joints]
        assert arm.observe().position_rad == pytest.approx(home_rad, abs=1e-3)
    finally:
        arm.close()
    unknown = driver.create(kind, ROBOTS / "ur5", {"room": str(LAB)}, "unknown")
    with pytest.raises(DriverError, match="no joint 'unknown/shoulder_pan'"):
        unknown.connect()


def test_the_twin_of_an_arm_includes_nearby_scenery_only():
    twin = place_driver(lab(), "ur5").twin()
    assert twin is not None
    assert twin.bodies[0].name == "scene"
    assert 7 <= len(twin.bodies[0].geometries) < 20
    assert len(msgspec.json.encode(twin)) < 64_000
    positions = [shape.position_m for shape in twin.bodies[0].geometries]
    assert any(position == pytest.approx((1.65 - 1.95, 0.0, -0.02), abs=1e-9) for position in positions)


def test_a_copy_is_consistent():
    world = lab()
    snapshot = world.step(500)
    data = mujoco.MjData(world.model)
    world.copy(data)
    assert data.time == snapshot.time_s
    assert np.abs(data.xpos - snapshot.body_position_m).max() < 1e-12
    assert np.array_equal(data.mocap_pos, snapshot.mocap_position_m)


# ------------------------------------------------------------ the person


def shapes_of_the_person(world: World) -> list[int]:
    model = world.model
    return [geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name.startswith("person")]


def test_the_person_walks_along_its_path_on_the_floor_without_contacts():
    world = lab(EMPTY)
    body = world.model.body("person").id
    walked = np.array([world.step(50).body_position_m[body] for _ in range(450)])
    for corner in MANIFEST.people[0].path_m:
        assert np.hypot(*(walked[:, :2] - corner).T).min() < 0.1
    speed = np.hypot(*np.diff(walked[:, :2], axis=0).T) / 0.1
    assert 0.7 < speed.max() < 0.9
    geoms = shapes_of_the_person(world)
    assert len(geoms) > 15
    assert not world.model.geom_contype[geoms].any()
    assert not world.model.geom_conaffinity[geoms].any()
    data = mujoco.MjData(world.model)
    lowest = []
    for _ in range(30):
        world.step(50)
        world.copy(data)
        lowest.append(min(data.geom_xpos[geom][2] - world.model.geom_size[geom][0] for geom in geoms))
    assert np.abs(lowest).max() < 0.03


def test_the_persons_path_is_free_of_obstacles():
    world = lab()
    data = mujoco.MjData(world.model)
    world.copy(data)
    people = shapes_of_the_person(world)
    hit = np.full(1, -1, dtype=np.int32)
    corners = np.array(MANIFEST.people[0].path_m)
    for start_m, end_m in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length_m = np.linalg.norm(end_m - start_m)
        direction = (end_m - start_m) / length_m
        for side_m in (-0.25, 0.0, 0.25):  # at hip width including elbows
            start = np.array((*(start_m + side_m * np.array((-direction[1], direction[0]))), 0.3))
            away_m = mujoco.mj_ray(world.model, data, start, np.array((*direction, 0.0)), None, True, -1, hit, None)
            assert away_m < 0 or away_m > length_m or hit[0] in people, (start_m, end_m, int(hit[0]))


def test_the_person_stops_for_a_robot_and_turns_around():
    pedestrian = Pedestrian(room.Person(name="person", path_m=((0.0, 0.0), (4.0, 0.0)), pause_s=0.0))
    xs = []
    for _ in range(600):
        pedestrian._advance(np.array([[2.0, 0.0, 0.0]]))
        xs.append(pedestrian.position_m[0])
    assert 1.2 < max(xs) < 1.5
    assert min(xs[200:]) < 0.1


def test_a_missing_body_of_the_person_is_an_error():
    unknown = room.Person(name="unknown", path_m=((0.0, 0.0), (1.0, 0.0)))
    with pytest.raises(DriverError, match="no mocap body 'unknown'"):
        lab(msgspec.structs.replace(EMPTY, people=(unknown,))).step(2)


# ------------------------------------------------------------ door, blinds, light


def test_settings_start_as_in_the_manifest_and_are_followed_at_limited_speed():
    world = lab(EMPTY)
    position = world.snapshot().position_rad
    assert position["blinds"] == position["blinds_east"] == MANIFEST.start["blinds"]
    assert position["door"] == pytest.approx(0.0, abs=1e-3)
    with pytest.raises(DriverError, match="not finite"):
        world.set("door", math.nan)
    assert world.set("door", 9.0) == 1.5
    assert 0.05 < world.step(500).position_rad["door"] < 0.8
    assert world.step(1500).position_rad["door"] == pytest.approx(1.5, abs=0.05)
    assert world.settings["door"] == 1.5
    world.step(8_000)
    # 0.018 m³/h of one person against 250 m³/h through the door: the corridor's air flows in from the first minute.
    assert world.quantities["co2_ppm"] < MANIFEST.climate.start_co2_ppm


def test_light_depends_on_window_and_lamp():
    world = lab(EMPTY)
    world.step(2)
    bright, lights = world.quantities["light_lux"], world.model.light_diffuse.copy()
    world.set("lamp", 0.0)
    world.step(200)
    assert world.quantities["light_lux"] == pytest.approx(
        bright - MANIFEST.climate.lamp_lux * MANIFEST.start["lamp"], abs=5
    )
    assert (world.model.light_diffuse <= lights).all()
    assert (world.model.light_diffuse[1:] == 0).all()
    world.set("blinds", 0.0)
    world.step(2500)
    assert world.quantities["light_lux"] < 0.12 * MANIFEST.climate.daylight_lux


# ------------------------------------------------------------ air


class Air:
    """The climate alone, by the hour."""

    def __init__(self, *, people: int = 0) -> None:
        self.world = World(Path("nothing"), settings={"thermostat": -50.0})
        self.climate = Climate(MANIFEST, self.world, [Pedestrian(MANIFEST.people[0]) for _ in range(people)])

    def after(self, hours: float, *, door: float = 0.0, blinds: float = 0.0) -> dict[str, float]:
        for _ in range(60):
            self.climate._advance(hours * 60, door=door, blinds=blinds)
        self.climate._publish()
        return dict(self.world.quantities)


def test_co2_converges_to_the_steady_state():
    climate = MANIFEST.climate
    fresh_m3_h = climate.ventilation_per_h * 6 * 5 * 2.7
    for people in (0, 2):
        steady_ppm = climate.outside_co2_ppm + people * 0.018 / fresh_m3_h * 1e6
        assert Air(people=people).after(12)["co2_ppm"] == pytest.approx(steady_ppm, abs=1)


def test_an_open_door_exchanges_air():
    shut, wide = Air(people=4).after(2), Air(people=4).after(2, door=1.0)
    corridor_c = MANIFEST.climate.corridor_c
    assert wide["co2_ppm"] < shut["co2_ppm"] - 400
    assert abs(wide["temperature_c"] - corridor_c) < abs(shut["temperature_c"] - corridor_c)


def test_people_add_heat_and_water():
    empty, full = Air().after(1), Air(people=5).after(1)
    assert full["temperature_c"] > empty["temperature_c"] + 0.5
    assert full["humidity_percent"] > empty["humidity_percent"]
    assert water_g_m3(20.0, 100.0) == pytest.approx(17.3, abs=0.1), "saturated water content"


def test_the_thermostat_controls_the_temperature():
    air = Air()
    air.world.settings["thermostat"] = 23.0  # type: ignore[index]
    assert air.after(6)["temperature_c"] == pytest.approx(22.6, abs=0.45)
    air.world.settings["thermostat"] = 12.0  # type: ignore[index]
    assert air.after(12)["temperature_c"] < 15


def test_the_air_model_is_independent_of_the_step():
    many, one = Air(people=1), Air(people=1)
    many.after(1)
    one.climate._advance(3600, door=0.0, blinds=0.0)
    one.climate._publish()
    for name, value in many.world.quantities.items():
        assert one.world.quantities[name] == pytest.approx(value, rel=1e-3)


# ------------------------------------------------------------ sound


def test_sound_decreases_with_distance_to_the_diffuse_level():
    assert received_db(60.0, 1.0) == pytest.approx(66.6, abs=0.2)  # the diffuse field adds to the direct one
    assert received_db(60.0, 0.5) > received_db(60.0, 1.0) > received_db(60.0, 3.0) > 60.0


def test_footsteps_and_speech_raise_the_sound_level():
    quiet = msgspec.structs.replace(MANIFEST.climate, quiet_db=20.0)
    world = lab(msgspec.structs.replace(MANIFEST, climate=quiet))
    world.step(300)
    before = world.quantities["sound_db"]
    place_driver(world, "ur5").start_speech(0.5)
    world.step(100)
    assert world.quantities["sound_db"] > before + 5
    world.step(300)
    assert world.quantities["sound_db"] < before + 3
    world.step(1500)  # its first pause is over
    assert world.quantities["sound_db"] > before + 5
