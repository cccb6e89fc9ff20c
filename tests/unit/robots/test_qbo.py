"""Driving and distance sensors of Qbo in its scene."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device_agent.drivers import load
from device_agent.drivers.mujoco import WheeledDriver
from device_agent.ports.driver import REST, DriverError, MobileDriver, ReportsStreams, Twist
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.simulation import world_registry
from tests.harness.paths import ROBOTS

FOLDER = ROBOTS / "qbo"


class DrivenQbo:
    """The manually stepped robot, with the agent's twist limits."""

    def __init__(self) -> None:
        self.type = robot_type.load(FOLDER)
        driver = load("mujoco")(self.type, FOLDER, {}, "qbo")
        assert isinstance(driver, WheeledDriver)
        self.driver = driver
        self.world = driver._world
        self.world.build()
        driver._resolve(self.world.model)
        driver._connected = True
        assert self.type.base is not None
        self.motion = BaseMotion(self.type.base, self.type.period_ms / 1000)
        self.steps = self.type.period_ms // 2
        driver.observe()

    def period(self) -> None:
        self.driver.drive(self.motion.update())
        self.world.step(self.steps)
        self.driver.observe()

    def go(self, twist: Twist, duration_s: float) -> None:
        for _ in range(round(duration_s * 1000 / self.type.period_ms)):
            self.motion.follow(twist)
            self.period()

    def rest(self, duration_s: float = 0.6) -> None:
        for _ in range(round(duration_s * 1000 / self.type.period_ms)):
            self.motion.brake()
            self.period()

    @property
    def truth(self) -> tuple[float, float, float]:
        """x, y [m], yaw [rad]."""
        snapshot = self.world.snapshot()
        x, y, _ = snapshot.body_position_m[self.driver._base].tolist()
        w, _, _, k = snapshot.body_quaternion[self.driver._base].tolist()
        return x, y, math.remainder(2 * math.atan2(k, w), 2 * math.pi)

    @property
    def speed(self) -> tuple[float, float]:
        """Linear [m/s] and angular [rad/s] speed."""
        velocity = self.world.snapshot().qvel[:6]
        return float(np.linalg.norm(velocity[:2])), float(velocity[5])

    def odometry(self) -> dict[str, Any]:
        return dict(self.driver.report("odometry"))


@pytest.fixture
def qbo() -> DrivenQbo:
    return DrivenQbo()


def test_it_drives_straight(qbo: DrivenQbo) -> None:
    qbo.go(Twist(0.3), 5.0)
    qbo.rest()
    x, y, yaw = qbo.truth
    assert x == pytest.approx(0.3 * 5.0, abs=0.1)
    assert abs(y) < 0.005
    assert abs(yaw) < 0.005
    values = qbo.odometry()
    assert values["x_m"] == pytest.approx(x, abs=0.01)
    assert values["y_m"] == pytest.approx(y, abs=0.005)
    assert values["forward_m_s"] == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize("side", [1, -1])
def test_it_turns_on_the_spot(qbo: DrivenQbo, side: int) -> None:
    qbo.go(Twist(0.0, 0.0, side * 1.0), 3.0)
    qbo.rest()
    x, y, yaw = qbo.truth
    assert math.hypot(x, y) < 0.005
    assert side * yaw == pytest.approx(3.0, abs=0.25)
    assert qbo.odometry()["yaw_rad"] == pytest.approx(yaw, abs=0.03)


def test_odometry_follows_a_long_way_and_drifts_a_little(qbo: DrivenQbo) -> None:
    for twist in (
        Twist(0.3),
        Twist(0.0, 0.0, 0.8),
        Twist(0.2, 0.0, 0.6),
        Twist(-0.2, 0.0, 0.3),
        Twist(0.25, 0.0, -0.7),
    ):
        qbo.go(twist, 3.0)
    qbo.rest()
    x, y, yaw = qbo.truth
    values = qbo.odometry()
    off_m = math.hypot(values["x_m"] - x, values["y_m"] - y)
    assert 0 < off_m < 0.05, "small error by wheel slip"
    assert abs(math.remainder(values["yaw_rad"] - yaw, 2 * math.pi)) < 0.08


def test_odometry_includes_wheel_slip(qbo: DrivenQbo) -> None:
    """Odometry integrates wheel rotation, even if the robot is lifted."""
    qbo.world._data.qpos[2] = 0.5
    qbo.world.model.opt.gravity[2] = 0.0
    before = qbo.truth
    qbo.go(Twist(0.3), 1.0)
    assert qbo.truth[0] == pytest.approx(before[0], abs=0.02)
    assert qbo.odometry()["x_m"] > 0.15


@pytest.mark.parametrize("twist", [Twist(0.3), Twist(-0.3), Twist(0.0, 0.0, 1.5), Twist(0.2, 0.0, -1.0)])
def test_it_stops_within_its_braking_limits(qbo: DrivenQbo, twist: Twist) -> None:
    qbo.go(twist, 2.0)
    linear, angular = qbo.speed
    assert max(linear / 0.3, abs(angular) / 1.5) > 0.6
    place = qbo.truth
    periods = 0
    while qbo.motion.moving:
        qbo.motion.brake()
        qbo.period()
        periods += 1
    assert periods * qbo.type.period_ms <= 180, "0.15 s at full speed, plus ramps"
    for _ in range(2):
        qbo.period()
    linear, angular = qbo.speed
    assert linear < 0.03
    assert abs(angular) < 0.05
    assert math.dist(place[:2], qbo.truth[:2]) < 0.04


def test_it_never_tips_over(qbo: DrivenQbo) -> None:
    random = np.random.default_rng(4)
    upright = 1.0
    for _ in range(40):
        qbo.go(Twist(random.uniform(-0.3, 0.3), 0.0, random.uniform(-1.5, 1.5)), 0.25)
        if random.random() < 0.3:
            qbo.rest(0.2)
        w, i, j, k = qbo.world.snapshot().body_quaternion[qbo.driver._base].tolist()
        assert math.isclose(math.hypot(w, i, j, k), 1.0, abs_tol=1e-6)
        upright = min(upright, 1 - 2 * (i * i + j * j))
    assert upright > math.cos(0.06)
    assert not qbo.world._data.warning.number.any()


def test_sideways_motion_is_ignored_and_fast_curves_keep_their_radius(qbo: DrivenQbo) -> None:
    assert qbo.driver.drive(Twist(0.1, 0.2, 0.0)) == Twist(0.1, 0.0, 0.0)
    fast = qbo.driver.drive(Twist(2.0, 0.0, 4.0))
    assert fast.turn_rad_s / fast.forward_m_s == pytest.approx(2.0)
    assert fast.forward_m_s < 0.5
    with pytest.raises(DriverError, match="not finite"):
        qbo.driver.drive(Twist(math.nan))
    qbo.driver.drive(REST)


def test_wheels_stop_without_commands(qbo: DrivenQbo) -> None:
    """Commands end during motion, as after a fault of the control loop."""
    qbo.go(Twist(0.3), 2.0)
    place = qbo.truth
    assert qbo.speed[0] > 0.25
    qbo.world.step(500)
    assert qbo.speed[0] < 0.01
    assert 0.3 * 0.25 < qbo.truth[0] - place[0] < 0.3 * 0.3 + 0.3**2 / 2 / 2.0 + 0.02
    qbo.world.step(500)
    assert qbo.speed[0] < 0.002
    qbo.motion.start()
    qbo.go(Twist(0.3), 2.0)
    assert qbo.speed[0] > 0.25, "new commands are executed"


def test_sonars_measure_an_approaching_wall(qbo: DrivenQbo) -> None:
    """The wall is at x = 2.0 m, the sonars 0.156 m in front of the axle."""
    readings = [qbo.driver.report("sonar")]
    while qbo.truth[0] < 1.0:
        qbo.go(Twist(0.3), 0.4)
        readings.append(qbo.driver.report("sonar"))
    qbo.rest()
    readings.append(qbo.driver.report("sonar"))
    room_m = 2.0 - 0.156 - qbo.truth[0]
    for part in ("left", "right"):
        values = [float(values[f"distance_m.{part}"]) for values in readings]
        assert values[0] == pytest.approx(2.0 - 0.156, abs=0.05)
        assert values == sorted(values, reverse=True)
        assert values[-1] == pytest.approx(room_m, abs=0.05)
        assert (values[-1] * 100) == pytest.approx(round(values[-1] * 100), abs=1e-6), "resolution of 10 mm"


def test_distance_sensors_report_their_range_without_an_echo(qbo: DrivenQbo) -> None:
    model, data = qbo.world.model, qbo.world._data
    data.qpos[:2] = (0.0, 0.0)
    data.qpos[3:7] = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))  # no wall to the left
    qbo.world.step(2)
    values = qbo.driver.report("sonar")
    assert values["distance_m.left"] == values["distance_m.right"] == 4.0
    assert values["distance_m.front"] == pytest.approx(0.04, abs=0.005)
    data.qpos[2] += 1.0  # like the edge of a stair
    qbo.world.step(2)
    assert qbo.driver.report("sonar")["distance_m.front"] == 0.3
    assert model.nq == len(data.qpos)


def test_odometry_starts_at_the_true_pose() -> None:
    qbo = DrivenQbo()
    qbo.world._data.qpos[:7] = (0.7, -0.4, 0.0, math.cos(0.5), 0.0, 0.0, math.sin(0.5))
    qbo.world.step(2)
    qbo.driver._resolve(qbo.world.model)
    qbo.driver.observe()
    values = qbo.odometry()
    assert (values["x_m"], values["y_m"], values["yaw_rad"]) == pytest.approx((0.7, -0.4, 1.0), abs=0.01)


@pytest.fixture
def connected(tmp_path: Path) -> Iterator[WheeledDriver]:
    driver = load("mujoco")(robot_type.load(FOLDER), FOLDER, {"faults": str(tmp_path / "qbo.toml")}, "qbo")
    assert isinstance(driver, WheeledDriver)
    assert isinstance(driver, MobileDriver)
    assert isinstance(driver, ReportsStreams)
    yield driver
    driver.close()


def test_only_health_is_reported_before_connect(connected: WheeledDriver) -> None:
    with pytest.raises(DriverError, match="not connected"):
        connected.report("odometry")
    with pytest.raises(DriverError, match="not connected"):
        connected.report("sonar")
    with pytest.raises(DriverError, match="not connected"):
        connected.drive(REST)
    assert connected.report("smell") == {}
    assert connected.report("health")["battery_percent"] == 100.0


def test_every_stream_of_the_manifest_is_reported(connected: WheeledDriver) -> None:
    connected.connect()
    connected.observe()
    streams = [stream.name for stream in robot_type.load(FOLDER).streams]
    assert streams == ["joints", "odometry", "sonar", "health"]
    for stream in streams[1:]:
        assert connected.report(stream)


def test_sonars_measure_a_person_in_the_laboratory() -> None:
    world = world_registry.get_world(ROBOTS / "rooms" / "lab")
    world.build()
    world._processes = ()  # no walking person
    driver = WheeledDriver(
        robot_type=robot_type.load(FOLDER), world=world, device="qbo", prefix=world_registry.prefix("qbo")
    )
    driver._resolve(world.model)
    driver._connected = True
    driver.observe()
    before = driver.report("sonar")
    placed = driver.report("odometry")
    x, y, yaw = (float(placed[name]) for name in ("x_m", "y_m", "yaw_rad"))
    person = world._data.mocap_pos
    person[:, :2] += np.array([x + 0.8 * math.cos(yaw), y + 0.8 * math.sin(yaw)]) - person[0, :2]
    world.step(2)
    after = driver.report("sonar")
    nearest_m = min(float(after["distance_m.left"]), float(after["distance_m.right"]))
    assert 0.4 < nearest_m < 0.8
    assert nearest_m < min(float(before["distance_m.left"]), float(before["distance_m.right"])) - 0.5
