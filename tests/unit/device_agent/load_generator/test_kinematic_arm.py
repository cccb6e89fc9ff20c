"""The kinematic arm respects speed and target, and stops without further commands."""

import math

import pytest

from device_agent.load_generator import robot
from device_agent.load_generator.kinematic_arm import SPEED_RAD_S, Arm, Shape, robot_type
from device_agent.runtime.control import setpoint_stream


@pytest.fixture
def arm() -> Arm:
    return Arm(Shape(robot_type("load-test-arm", 3, 5.0)), 0.0)


def test_joints_move_at_the_given_speed_and_stop_at_the_target(arm: Arm) -> None:
    arm.go([1.5, -0.3, 0.0], speed=0.5)
    arm.advance(1.0)
    assert arm.position_rad == pytest.approx([0.5 * SPEED_RAD_S, -0.3, 0.0])
    assert arm.velocity_rad_s == pytest.approx([0.5 * SPEED_RAD_S, -0.3, 0.0])
    arm.advance(3.0)
    assert arm.position_rad == [1.5, -0.3, 0.0]
    arm.advance(3.1)
    assert arm.arrived
    assert arm.velocity_rad_s == [0.0] * 3


def test_motion_ends_at_the_given_time_independent_of_the_update_interval(arm: Arm) -> None:
    arm.go([3.0, 0.0, 0.0], speed=1.0, until_s=0.3)
    arm.advance(10.0)
    assert arm.position_rad[0] == pytest.approx(0.3 * SPEED_RAD_S)
    assert arm.arrived
    assert arm.velocity_rad_s == [0.0] * 3


def test_no_motion_without_elapsed_time(arm: Arm) -> None:
    arm.go([3.0, 0.0, 0.0], speed=1.0)
    arm.advance(0.0)
    assert arm.position_rad == [0.0] * 3
    assert not math.isnan(arm.velocity_rad_s[0])


def test_timeouts_equal_those_of_a_real_agent() -> None:
    assert (robot.WATCHDOG_S, robot.MAX_LOOP_AGE_S) == (setpoint_stream.WATCHDOG_S, setpoint_stream.MAX_LOOP_AGE_S)
