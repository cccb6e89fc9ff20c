"""Steps of the driver contract: waiting, observing as the agent does, reconnecting, moving."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping

import pytest

from device_agent.drivers.testing.peer import Disturbance, Peer
from device_agent.ports.driver import Driver, DriverError, MobileDriver, Observation, ReportsFaults, Twist
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.control import measurement

FAST = 0.5
"""Speed of a base that drives, as a share of the commanded speed."""


class ContractSteps:
    """What a test class states about its driver, and the steps of its tests.

    Attributes:
        simulated: What ``Driver.simulated`` must be.
        absent: Disturbances that cannot occur, with the reason. Only a simulation has no connection.
        deadline_s: Time for each reaction [s]. It only bounds the duration of failing tests.
        tolerance_rad: Error of a joint at rest [rad].
    """

    simulated = False
    absent: Mapping[Disturbance, str] = {}
    deadline_s = 60.0
    tolerance_rad = 0.02

    def until(self, condition: Callable[[], object]) -> None:
        """Wait until a condition is true."""
        end_s = time.monotonic() + self.deadline_s
        while not condition():
            assert time.monotonic() < end_s, f"not within {self.deadline_s:.0f} s"
            time.sleep(0.005)

    def in_time(self, call: Callable[[], object]) -> BaseException | None:
        """Call in another thread. Fails if the call blocks; returns its exception."""
        errors: list[BaseException | None] = []

        def run() -> None:
            try:
                call()
            except Exception as error:  # noqa: BLE001 (the caller checks it)
                errors.append(error)
            else:
                errors.append(None)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        thread.join(self.deadline_s)
        assert errors, "the call blocks"
        return errors[0]

    def observe(self, driver: Driver, robot_type: RobotType) -> Observation:
        """A measurement that the agent accepts.

        Raises:
            DriverError: There is none. Values that are not finite fail the test.
        """
        observation = driver.observe()
        for values in (observation.position_rad, observation.velocity_rad_s, observation.effort_nm):
            assert all(map(math.isfinite, values)), "the driver returns values that are not finite"
        measurement.check(observation, joints=len(robot_type.joints), now_s=time.monotonic())
        return observation

    def lost(self, driver: Driver, robot_type: RobotType) -> bool:
        """Whether the agent has noticed that there is no valid measurement."""
        error = self.in_time(lambda: self.observe(driver, robot_type))
        assert error is None or isinstance(error, DriverError), repr(error)
        return error is not None

    def reconnect(self, driver: Driver, robot_type: RobotType) -> None:
        """Connect as the agent does, until there is a measurement."""

        def connects() -> bool:
            with contextlib.suppress(DriverError):
                driver.connect()
                self.observe(driver, robot_type)
                return True
            return False

        self.until(connects)

    def is_absent(self, disturbance: Disturbance, driver: Driver) -> bool:
        """Whether the device declares that a disturbance cannot occur; checks that this is plausible."""
        if disturbance not in self.absent:
            return False
        assert self.absent[disturbance], "give the reason"
        if disturbance in {Disturbance.CONNECTION, Disturbance.SILENCE, Disturbance.CLOCK}:
            assert driver.simulated, "every real device has a connection that can fail"
        if disturbance is Disturbance.SAFETY:
            assert not isinstance(driver, ReportsFaults)
        return True

    def near(self, values: tuple[float, ...], target: tuple[float, ...]) -> bool:
        """Whether joints are at their targets [rad]."""
        return all(math.isclose(a, b, abs_tol=self.tolerance_rad) for a, b in zip(values, target, strict=True))

    def nudged(self, robot_type: RobotType, position: tuple[float, ...]) -> tuple[float, ...]:
        """A target up to 0.1 rad from ``position``, different for each joint, inside the limits."""
        joints, target = robot_type.joints, []
        for index, (value, joint) in enumerate(zip(position, joints, strict=True)):
            step = 0.1 * (1 - 0.5 * index / len(joints))
            target.append(value + step if value + step <= joint.upper_rad else value - step)
        return tuple(target)

    def move(self, driver: Driver, peer: Peer, target: tuple[float, ...], robot_type: RobotType) -> None:
        """Command a target as the agent does, until the true and the measured position are there."""

        def arrives() -> bool:
            assert driver.send(target) == pytest.approx(target)
            measured = self.observe(driver, robot_type).position_rad
            return self.near(peer.joint_positions(), target) and self.near(measured, target)

        self.until(arrives)

    def drives(self, driver: Driver, peer: Peer, twist: Twist, hold: tuple[float, ...]) -> bool:
        """Command a base; whether it drives."""
        assert isinstance(driver, MobileDriver)
        driver.send(hold)
        driver.drive(twist)
        return peer.base_twist().forward_m_s > FAST * twist.forward_m_s
