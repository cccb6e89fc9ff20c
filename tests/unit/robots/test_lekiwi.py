"""Driving of LeKiwi in its scene, and its arm."""

import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from device_agent.drivers.mujoco import OmniDriver, World, _driver_class
from device_agent.ports.driver import REST, DriverError, MobileDriver, ReportsStreams, Twist
from device_agent.protocol import StopLatch
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.capabilities import Simulation
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import SteppedRobot
from tests.unit.robots.simulated_robot import SimulatedRobot

pytestmark = pytest.mark.slow
FOLDER = ROBOTS / "lekiwi"
WHEELS = ("base_left_wheel", "base_back_wheel", "base_right_wheel")
WHEEL_ANGLES_RAD = np.radians([150.0, -90.0, 30.0])
BASE_RADIUS_M = 0.125
"""Kinematics of LeRobot's class ``LeKiwi``; left, back, right."""


@pytest.fixture
def lekiwi() -> SimulatedRobot:
    return SimulatedRobot(FOLDER)


@pytest.mark.parametrize(
    ("twist", "moved"),
    [
        (Twist(0.15), (0.3, 0.0, 0.0)),
        (Twist(0.0, 0.15), (0.0, 0.3, 0.0)),
        (Twist(0.0, -0.15), (0.0, -0.3, 0.0)),
        (Twist(-0.1, 0.1), (-0.2, 0.2, 0.0)),
        (Twist(0.0, 0.0, 0.8), (0.0, 0.0, 1.6)),
    ],
)
def test_it_drives_in_every_direction_and_turns_on_the_spot(
    lekiwi: SimulatedRobot, twist: Twist, moved: tuple[float, float, float]
) -> None:
    goal = lekiwi.controller.start_drive(lekiwi.reservation, twist, duration_s=2.0)
    lekiwi.wait(1.5)
    odometry = lekiwi.driver.report("odometry")
    assert [odometry[name] for name in Twist._fields] == pytest.approx(twist, abs=0.01)
    lekiwi.follow(goal)
    lekiwi.wait(0.5)
    assert lekiwi.pose[:2] == pytest.approx(moved[:2], abs=0.05)
    assert lekiwi.pose[2] == pytest.approx(moved[2], abs=0.25)
    assert [lekiwi.driver.report("odometry")[name] for name in Twist._fields] == pytest.approx(REST, abs=2e-3)


def test_a_turned_base_drives_and_measures_in_its_own_axes(lekiwi: SimulatedRobot) -> None:
    lekiwi.drive(Twist(0.0, 0.0, 1.0), duration_s=math.pi / 2)
    lekiwi.wait(0.5)
    x, y, yaw = lekiwi.pose
    goal = lekiwi.controller.start_drive(lekiwi.reservation, Twist(0.15), duration_s=2.0)
    lekiwi.wait(1.5)
    assert lekiwi.driver.report("odometry")["forward_m_s"] == pytest.approx(0.15, abs=0.01)
    lekiwi.follow(goal)
    driven = np.array(lekiwi.pose[:2]) - (x, y)
    assert math.atan2(driven[1], driven[0]) == pytest.approx(yaw, abs=0.03)


def test_wheels_have_the_speeds_of_lerobots_kinematics(lekiwi: SimulatedRobot) -> None:
    columns = [np.cos(WHEEL_ANGLES_RAD), np.sin(WHEEL_ANGLES_RAD), np.full(3, BASE_RADIUS_M)]
    assert lekiwi.driver._rolling == pytest.approx(np.stack(columns, axis=1), abs=1e-5)


def test_a_twist_beyond_the_wheels_keeps_its_direction(lekiwi: SimulatedRobot) -> None:
    assert lekiwi.driver.drive(Twist(0.1, 0.1, 0.2)) == Twist(0.1, 0.1, 0.2)
    applied = lekiwi.driver.drive(Twist(1.0, 2.0, 3.0))
    assert applied.left_m_s / applied.forward_m_s == pytest.approx(2.0)
    assert applied.turn_rad_s / applied.forward_m_s == pytest.approx(3.0)
    assert np.abs(lekiwi.driver._rolling @ np.array(applied)).max() == pytest.approx(0.23)
    with pytest.raises(DriverError, match="not finite"):
        lekiwi.driver.drive(Twist(0.0, math.nan))


@pytest.mark.parametrize("twist", [Twist(0.2), Twist(0.0, 0.2), Twist(0.0, 0.0, 1.2)])
def test_it_stops_within_its_braking_limits(lekiwi: SimulatedRobot, twist: Twist) -> None:
    lekiwi.controller.start_drive(lekiwi.reservation, twist, duration_s=2.0)
    lekiwi.wait(1.5)
    start_m = lekiwi.position_m
    lekiwi.controller.stop(StopLatch(caller="ann", reason="", at_ms=1))
    lekiwi.wait(0.24)
    assert np.abs(lekiwi.world.snapshot().qvel[:6]).max() < 0.03
    assert math.dist(start_m, lekiwi.position_m) < 0.04


def test_wheels_stop_without_commands(lekiwi: SimulatedRobot) -> None:
    """Commands end during motion, as after a fault of the control loop."""
    lekiwi.controller.start_drive(lekiwi.reservation, Twist(0.0, 0.15), duration_s=2.0)
    lekiwi.wait(1.5)
    assert lekiwi.world.snapshot().qvel[1] > 0.13
    lekiwi.world.step(300)
    assert abs(lekiwi.world.snapshot().qvel[1]) < 0.01


def test_a_halt_stops_the_wheels_at_once(lekiwi: SimulatedRobot) -> None:
    lekiwi.controller.start_drive(lekiwi.reservation, Twist(0.15), duration_s=2.0)
    lekiwi.wait(1.5)
    lekiwi.driver.halt()
    lekiwi.world.step(120)
    assert abs(lekiwi.world.snapshot().qvel[0]) < 0.01


def test_a_moving_arm_hardly_moves_the_base(lekiwi: SimulatedRobot) -> None:
    lekiwi.move({"arm_shoulder_pan": 1.5, "arm_elbow_flex": 0.6}, speed=0.5)
    lekiwi.move(lekiwi.type.home_rad, speed=0.5)
    assert math.hypot(*lekiwi.pose[:2]) < 0.01
    assert abs(lekiwi.pose[2]) < 0.02
    assert lekiwi.least_upright > math.cos(0.02)


def test_the_arm_is_that_of_the_so101_on_the_base() -> None:
    arm, lekiwi = SteppedRobot(ROBOTS / "so101"), SteppedRobot(FOLDER)
    mount = lekiwi.data.body("arm").xpos.copy()
    random = np.random.default_rng(101)
    for _ in range(20):
        position_rad = random.uniform(arm.lower, arm.upper)
        arm.place(position_rad)
        lekiwi.place(position_rad)
        for frame in arm.type.frames:
            found = lekiwi.data.site(f"arm_{frame}").xpos - mount
            assert found == pytest.approx(arm.data.site(frame).xpos, abs=1e-6), frame
    for body in ("shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw"):
        assert lekiwi.model.body(body).mass[0] == pytest.approx(arm.model.body(body).mass[0])


def test_streams_and_motion_need_a_connection() -> None:
    kind = robot_type.load(FOLDER)
    driver = _driver_class(kind)(robot_type=kind, world=World(FOLDER / kind.scene, home=kind.home_rad), device="kiwi")
    assert isinstance(driver, OmniDriver)
    assert isinstance(driver, MobileDriver)
    assert isinstance(driver, ReportsStreams)
    for call in (lambda: driver.report("odometry"), lambda: driver.drive(REST)):
        with pytest.raises(DriverError, match="not connected"):
            call()
    driver.connect()
    try:
        assert set(driver.report("odometry")) == set(Twist._fields)
        assert driver.report("health")
    finally:
        driver.close()


@pytest.mark.parametrize(
    ("wheels", "message"),
    [
        (None, r"needs omni_wheels in \[simulation\], and a \[base\]"),
        ((*WHEELS[:2], "base_front_wheel"), "no actuator 'base_front_wheel'"),
        ((*WHEELS[:2], "arm_gripper"), "actuator 'arm_gripper' of 'lekiwi' is not a velocity servo"),
    ],
)
def test_wheels_that_do_not_fit_the_model_are_described(wheels: tuple[str, ...] | None, message: str) -> None:
    kind = replace(robot_type.load(FOLDER), simulation=Simulation(omni_wheels=wheels))
    with pytest.raises(DriverError, match=message):
        OmniDriver(robot_type=kind, world=World(FOLDER / kind.scene, home=kind.home_rad), device="kiwi").connect()


def test_a_base_that_is_fixed_is_described(tmp_path: Path) -> None:
    text = (FOLDER / "lekiwi.xml").read_text(encoding="utf-8")
    (tmp_path / "lekiwi.xml").write_text(text.replace('<freejoint name="floating"/>', ""), encoding="utf-8")
    kind = robot_type.load(FOLDER)
    world = World(tmp_path / "lekiwi.xml", home=kind.home_rad)
    with pytest.raises(DriverError, match="the base of 'lekiwi' has no free joint"):
        OmniDriver(robot_type=kind, world=world, device="kiwi").connect()
