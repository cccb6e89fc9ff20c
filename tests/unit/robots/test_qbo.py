"""Driving and distance sensors of Qbo in its scene."""

import math

import numpy as np
import pytest

from device_agent.drivers import load
from device_agent.drivers.mujoco import WheeledDriver
from device_agent.ports.driver import REST, DriverError, MobileDriver, ReportsStreams, Twist
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.control.base_motion import BaseMotion
from device_agent.simulation import world_registry
from tests.harness.paths import ROBOTS
from tests.unit.robots.simulated_robot import SimulatedRobot

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "qbo"


class DrivenQbo(SimulatedRobot):
    """The robot with the agent's twist limits, driven without goals."""

    def __init__(self) -> None:
        super().__init__(FOLDER)
        assert self.type.base is not None
        self.motion = BaseMotion(self.type.base, self.period_s)
        self.driver.observe()

    def run_period(self) -> None:
        self.driver.drive(self.motion.update())
        self.world.step(self.type.period_ms // 2)
        self.driver.observe()

    def drive_for(self, twist: Twist, duration_s: float) -> None:
        for _ in range(round(duration_s / self.period_s)):
            self.motion.follow(twist)
            self.run_period()

    def brake_for(self, duration_s: float = 0.6) -> None:
        for _ in range(round(duration_s / self.period_s)):
            self.motion.brake()
            self.run_period()

    @property
    def speed(self) -> tuple[float, float]:
        """Linear [m/s] and angular [rad/s] speed."""
        velocity = self.world.snapshot().qvel[:6]
        return float(np.linalg.norm(velocity[:2])), float(velocity[5])


@pytest.fixture
def qbo() -> DrivenQbo:
    return DrivenQbo()


def test_it_drives_straight(qbo: DrivenQbo) -> None:
    qbo.drive_for(Twist(0.3), 5.0)
    qbo.brake_for()
    x, y, yaw = qbo.pose
    assert x == pytest.approx(0.3 * 5.0, abs=0.1)
    assert abs(y) < 0.005
    assert abs(yaw) < 0.005
    odometry = qbo.driver.report("odometry")
    assert odometry["x_m"] == pytest.approx(x, abs=0.01)
    assert odometry["y_m"] == pytest.approx(y, abs=0.005)
    assert odometry["forward_m_s"] == pytest.approx(0.0, abs=0.002)


@pytest.mark.parametrize("side", [1, -1])
def test_it_turns_on_the_spot(qbo: DrivenQbo, side: int) -> None:
    qbo.drive_for(Twist(0.0, 0.0, side * 1.0), 3.0)
    qbo.brake_for()
    x, y, yaw = qbo.pose
    assert math.hypot(x, y) < 0.005
    assert side * yaw == pytest.approx(3.0, abs=0.25)
    assert qbo.driver.report("odometry")["yaw_rad"] == pytest.approx(yaw, abs=0.03)


def test_odometry_follows_a_long_path_and_drifts_a_little(qbo: DrivenQbo) -> None:
    for forward_m_s, turn_rad_s in ((0.3, 0.0), (0.0, 0.8), (0.2, 0.6), (-0.2, 0.3), (0.25, -0.7)):
        qbo.drive_for(Twist(forward_m_s, 0.0, turn_rad_s), 3.0)
    qbo.brake_for()
    x, y, yaw = qbo.pose
    odometry = qbo.driver.report("odometry")
    assert 0 < math.dist((odometry["x_m"], odometry["y_m"]), (x, y)) < 0.05, "small error by wheel slip"
    assert abs(math.remainder(odometry["yaw_rad"] - yaw, 2 * math.pi)) < 0.08


def test_odometry_starts_at_the_true_pose_and_includes_wheel_slip(qbo: DrivenQbo) -> None:
    qbo.world._data.qpos[:7] = (0.7, -0.4, 0.5, math.cos(0.5), 0.0, 0.0, math.sin(0.5))
    qbo.world.model.opt.gravity[2] = 0.0  # the wheels are lifted
    qbo.world.step(2)
    qbo.driver._resolve(qbo.world.model)
    qbo.driver.observe()
    start = qbo.driver.report("odometry")
    assert (start["x_m"], start["y_m"], start["yaw_rad"]) == pytest.approx((0.7, -0.4, 1.0), abs=0.01)
    qbo.drive_for(Twist(0.3), 1.0)
    assert qbo.pose[:2] == pytest.approx((0.7, -0.4), abs=0.02)
    odometry = qbo.driver.report("odometry")
    assert math.dist((odometry["x_m"], odometry["y_m"]), (0.7, -0.4)) > 0.15


@pytest.mark.parametrize("twist", [Twist(0.3), Twist(-0.3), Twist(0.0, 0.0, 1.5), Twist(0.2, 0.0, -1.0)])
def test_it_stops_within_its_braking_limits(qbo: DrivenQbo, twist: Twist) -> None:
    qbo.drive_for(twist, 2.0)
    linear, angular = qbo.speed
    assert max(linear / 0.3, abs(angular) / 1.5) > 0.6
    start_m = qbo.pose[:2]
    periods = 0
    while qbo.motion.moving:
        qbo.motion.brake()
        qbo.run_period()
        periods += 1
    assert periods * qbo.type.period_ms <= 180, "0.15 s at full speed, plus ramps"
    for _ in range(2):
        qbo.run_period()
    linear, angular = qbo.speed
    assert linear < 0.03
    assert abs(angular) < 0.05
    assert math.dist(start_m, qbo.pose[:2]) < 0.04


def test_it_never_tips_over(qbo: DrivenQbo) -> None:
    random = np.random.default_rng(4)
    upright = 1.0
    for _ in range(40):
        qbo.drive_for(Twist(random.uniform(-0.3, 0.3), 0.0, random.uniform(-1.5, 1.5)), 0.25)
        if random.random() < 0.3:
            qbo.brake_for(0.2)
        upright = min(upright, qbo.upright)
    assert upright > math.cos(0.06)
    assert not qbo.world._data.warning.number.any()


def test_sideways_motion_is_ignored_and_fast_curves_keep_their_radius(qbo: DrivenQbo) -> None:
    assert qbo.driver.drive(Twist(0.1, 0.2, 0.0)) == Twist(0.1, 0.0, 0.0)
    fast = qbo.driver.drive(Twist(2.0, 0.0, 4.0))
    assert fast.turn_rad_s / fast.forward_m_s == pytest.approx(2.0)
    assert fast.forward_m_s < 0.5
    with pytest.raises(DriverError, match="not finite"):
        qbo.driver.drive(Twist(math.nan))


def test_wheels_stop_without_commands(qbo: DrivenQbo) -> None:
    """Commands end during motion, as after a fault of the control loop."""
    qbo.drive_for(Twist(0.3), 2.0)
    x_m = qbo.pose[0]
    assert qbo.speed[0] > 0.25
    qbo.world.step(500)
    assert qbo.speed[0] < 0.01
    assert 0.3 * 0.25 < qbo.pose[0] - x_m < 0.3 * 0.3 + 0.3**2 / 2 / 2.0 + 0.02
    qbo.world.step(500)
    assert qbo.speed[0] < 0.002
    qbo.motion.start()
    qbo.drive_for(Twist(0.3), 2.0)
    assert qbo.speed[0] > 0.25, "new commands are executed"


def test_sonars_measure_an_approaching_wall(qbo: DrivenQbo) -> None:
    """The wall is at x = 2.0 m, the sonars 0.156 m in front of the axle."""
    readings = [qbo.driver.report("sonar")]
    while qbo.pose[0] < 1.0:
        qbo.drive_for(Twist(0.3), 0.4)
        readings.append(qbo.driver.report("sonar"))
    qbo.brake_for()
    readings.append(qbo.driver.report("sonar"))
    for part in ("left", "right"):
        values = [float(values[f"distance_m.{part}"]) for values in readings]
        assert values[0] == pytest.approx(2.0 - 0.156, abs=0.05)
        assert values == sorted(values, reverse=True)
        assert values[-1] == pytest.approx(2.0 - 0.156 - qbo.pose[0], abs=0.05)
        assert (values[-1] * 100) == pytest.approx(round(values[-1] * 100), abs=1e-6), "resolution of 10 mm"


def test_distance_sensors_report_their_range_without_an_echo(qbo: DrivenQbo) -> None:
    data = qbo.world._data
    data.qpos[:2] = (0.0, 0.0)
    data.qpos[3:7] = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))  # no wall to the left
    qbo.world.step(2)
    values = qbo.driver.report("sonar")
    assert values["distance_m.left"] == values["distance_m.right"] == 4.0
    assert values["distance_m.front"] == pytest.approx(0.04, abs=0.005)
    data.qpos[2] += 1.0  # like the edge of a stair
    qbo.world.step(2)
    assert qbo.driver.report("sonar")["distance_m.front"] == 0.3


def test_only_health_is_reported_before_connect_and_every_stream_after() -> None:
    driver = load("mujoco")(robot_type.load(FOLDER), FOLDER, {}, "qbo")
    assert isinstance(driver, WheeledDriver)
    assert isinstance(driver, MobileDriver)
    assert isinstance(driver, ReportsStreams)
    for call in (lambda: driver.report("odometry"), lambda: driver.report("sonar"), lambda: driver.drive(REST)):
        with pytest.raises(DriverError, match="not connected"):
            call()
    assert driver.report("smell") == {}
    assert driver.report("health")["battery_percent"] == 100.0
    driver.connect()
    try:
        driver.observe()
        streams = [stream.name for stream in robot_type.load(FOLDER).streams]
        assert streams == ["joints", "odometry", "sonar", "health"]
        assert all(driver.report(stream) for stream in streams[1:])
    finally:
        driver.close()


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

    def nearest_m() -> float:
        sonar = driver.report("sonar")
        return min(float(sonar["distance_m.left"]), float(sonar["distance_m.right"]))

    before_m = nearest_m()
    odometry = driver.report("odometry")
    x, y, yaw = (float(odometry[name]) for name in ("x_m", "y_m", "yaw_rad"))
    person = world._data.mocap_pos
    person[:, :2] += np.array([x + 0.8 * math.cos(yaw), y + 0.8 * math.sin(yaw)]) - person[0, :2]
    world.step(2)
    assert 0.4 < nearest_m() < min(0.8, before_m - 0.5)
