"""Contract of every driver. A third party inherits ``DriverContract`` and supplies ``robot_type`` and ``driver``."""

import math
import time
from collections.abc import Callable

import pytest

from device_agent.ports.driver import Driver, DriverError, MobileDriver, Observation, Twist
from device_agent.protocol import codec
from device_agent.protocol.manifests.robot_type import RobotType

DEADLINE_S = 60.0
FAST, REST = 0.5, 0.1
"""Speed of a base that drives, and that rests, as a share of the commanded speed."""


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, f"not within {DEADLINE_S:.0f} s"
        time.sleep(0.005)


class DriverContract:
    """The suite. ``driver`` supplies an unconnected driver and closes it afterwards."""

    @pytest.fixture
    def robot_type(self) -> RobotType:
        raise NotImplementedError

    @pytest.fixture
    def driver(self, robot_type: RobotType) -> Driver:
        raise NotImplementedError

    @pytest.fixture
    def connected(self, driver: Driver) -> Driver:
        driver.connect()
        return driver

    def base_m_s(self, driver: Driver) -> float:
        """Measured forward speed of a mobile robot [m/s]."""
        raise NotImplementedError

    @staticmethod
    def near(observation: Observation, target: tuple[float, ...]) -> bool:
        return all(math.isclose(a, b, abs_tol=0.02) for a, b in zip(observation.position_rad, target, strict=True))

    def nudged(self, robot_type: RobotType, position: tuple[float, ...]) -> tuple[float, ...]:
        """A target 0.1 rad from ``position`` in each joint, inside the limits."""
        limits = robot_type.joints
        return tuple(
            value + 0.1 if value + 0.1 <= joint.upper_rad else value - 0.1
            for value, joint in zip(position, limits, strict=True)
        )

    def test_it_works_between_connect_and_close_only(self, driver: Driver, robot_type: RobotType) -> None:
        assert isinstance(driver.simulated, bool)
        home = [robot_type.home_rad[joint.name] for joint in robot_type.joints]
        for call in (driver.observe, lambda: driver.send(home)):
            with pytest.raises(DriverError):
                call()
        driver.close()
        driver.connect()
        driver.connect()
        driver.observe()
        driver.close()
        driver.close()
        with pytest.raises(DriverError):
            driver.observe()

    def test_observation_has_every_joint_and_frame(self, connected: Driver, robot_type: RobotType) -> None:
        observation = connected.observe()
        for values in (observation.position_rad, observation.velocity_rad_s, observation.effort_nm):
            assert len(values) == len(robot_type.joints)
            assert all(type(value) is float and math.isfinite(value) for value in values)
        assert len(observation.frames) == len(robot_type.frames)
        for pose in observation.frames:
            assert all(type(value) is float for value in pose)
            assert math.isclose(math.hypot(*pose[3:]), 1.0, abs_tol=1e-6)

    def test_it_does_not_move_after_connect(self, connected: Driver) -> None:
        before = connected.observe().position_rad
        time.sleep(0.1)
        # Robots on wheels or feet settle by about a millimetre, and their heads move equally.
        assert connected.observe().position_rad == pytest.approx(before, abs=5e-3)

    def test_send_clamps_and_returns_the_applied_values(self, connected: Driver, robot_type: RobotType) -> None:
        now = list(connected.observe().position_rad)
        now[0] = robot_type.joints[0].upper_rad + 100
        applied = connected.send(now)
        assert applied[0] <= robot_type.joints[0].upper_rad
        assert applied[1:] == pytest.approx(tuple(now[1:]))
        connected.send(connected.observe().position_rad)

    def test_invalid_positions_are_rejected(self, connected: Driver) -> None:
        before = connected.observe().position_rad
        for invalid in (math.nan, math.inf, -math.inf):
            with pytest.raises(DriverError, match="finite"):
                connected.send([invalid, *before[1:]])
        with pytest.raises(DriverError, match="positions"):
            connected.send([*before, 0.0])
        time.sleep(0.05)
        assert connected.observe().position_rad == pytest.approx(before, abs=1e-2)

    def test_send_moves_the_joints_and_reconnecting_keeps_them(self, connected: Driver, robot_type: RobotType) -> None:
        target = self.nudged(robot_type, connected.observe().position_rad)
        assert connected.send(target) == pytest.approx(target)
        until(lambda: self.near(connected.observe(), target))
        connected.close()
        connected.connect()
        assert self.near(connected.observe(), target)

    def test_a_halted_device_holds_and_accepts_commands_only_after_a_reconnect(
        self, connected: Driver, robot_type: RobotType
    ) -> None:
        target = self.nudged(robot_type, connected.observe().position_rad)
        connected.halt()
        connected.halt()
        before = connected.observe().position_rad
        with pytest.raises(DriverError):
            connected.send(target)
        time.sleep(0.05)
        assert connected.observe().position_rad == pytest.approx(before, abs=1e-2)
        connected.connect()
        connected.send(target)
        until(lambda: self.near(connected.observe(), target))

    def test_it_may_be_halted_at_any_time(self, driver: Driver) -> None:
        driver.halt()
        driver.connect()
        driver.send(driver.observe().position_rad)
        driver.close()
        driver.halt()

    @pytest.mark.parametrize("halted", [False, True])
    def test_a_base_stops_without_commands_and_when_it_is_halted(
        self, connected: Driver, robot_type: RobotType, *, halted: bool
    ) -> None:
        if robot_type.base is None:
            return
        assert isinstance(connected, MobileDriver)
        twist = Twist(forward_m_s=0.5 * robot_type.base.max_linear_m_s)

        def drives() -> bool:
            connected.send(home)
            connected.drive(twist)
            return self.base_m_s(connected) > FAST * twist.forward_m_s

        home = connected.observe().position_rad
        until(drives)
        if halted:
            connected.halt()
            with pytest.raises(DriverError):
                connected.drive(twist)
        until(lambda: abs(self.base_m_s(connected)) < REST * twist.forward_m_s)
        connected.connect()
        until(drives)

    def test_twin_is_a_tree_that_fits_a_retained_message(self, connected: Driver, robot_type: RobotType) -> None:
        twin = connected.twin()
        if twin is None:
            return
        codec.encode(twin, limit=codec.MAX_RETAINED_BYTES)
        for index, body in enumerate(twin.bodies):
            assert -1 <= body.parent < index
        moved = [body.joint.name for body in twin.bodies if body.joint]
        assert len(moved) == len(set(moved))
        assert {joint.name for joint in robot_type.joints} <= set(moved)
