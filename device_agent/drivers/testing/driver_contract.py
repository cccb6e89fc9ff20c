"""Contract of every driver. A driver's tests inherit ``DriverContract`` and supply its fixtures.

The suite sees a driver as the agent does: ``observe`` counts only if the agent accepts the measurement.
"""

import math
import threading
import time

import pytest

from device_agent.drivers.testing.contract_steps import ContractSteps
from device_agent.drivers.testing.peer import Disturbance, Peer
from device_agent.ports import threads
from device_agent.ports.driver import Driver, DriverError, MobileDriver, ReportsFaults, Twist, UnreachableError
from device_agent.protocol import codec
from device_agent.protocol.manifests.robot_type import RobotType

AT_REST = 0.1
"""Speed of a base that rests, as a share of the commanded speed."""
_REST_RAD_S = 0.05
_NO_MEASUREMENT = (Disturbance.SILENCE, Disturbance.GARBAGE, Disturbance.TRUNCATED, Disturbance.NAN, Disturbance.CLOCK)


class DriverContract(ContractSteps):
    """The suite. No test is skipped: what cannot happen to a device is listed in ``absent``, which is checked too."""

    @pytest.fixture
    def robot_type(self) -> RobotType:
        """The robot type that the driver drives."""
        raise NotImplementedError

    @pytest.fixture
    def peer(self) -> Peer:
        """The running device; it is ended afterwards. It may depend on ``driver`` or the reverse."""
        raise NotImplementedError

    @pytest.fixture
    def driver(self) -> Driver:
        """An unconnected driver; it is closed afterwards."""
        raise NotImplementedError

    @pytest.fixture
    def connected(self, driver: Driver, peer: Peer) -> Driver:
        """A connected driver."""
        del peer
        driver.connect()
        return driver

    # ------------------------------------------------------------ without a connection

    def test_it_tells_whether_it_is_simulated(self, driver: Driver) -> None:
        """Operators see this flag."""
        assert driver.simulated is self.simulated

    def test_it_works_between_connect_and_close_only(self, driver: Driver, peer: Peer, robot_type: RobotType) -> None:
        """Before and after, it neither moves nor reports anything."""
        del peer
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

    def test_a_missing_device_is_described_and_reported(self, driver: Driver, peer: Peer) -> None:
        """The agent starts without the device, and shows it as failed."""
        if self.is_absent(Disturbance.CONNECTION, driver):
            return
        peer.disturb(Disturbance.CONNECTION)
        error = self.in_time(driver.connect)
        assert isinstance(error, UnreachableError), repr(error)
        assert str(error)
        self.in_time(driver.twin)
        assert driver.simulated is self.simulated
        assert isinstance(self.in_time(driver.observe), DriverError)
        if isinstance(driver, ReportsFaults):
            assert not driver.faults(), "they are unknown"
        driver.close()

    def test_it_may_be_halted_at_any_time(self, driver: Driver, peer: Peer) -> None:
        """Also without a connection."""
        del peer
        driver.halt()
        driver.connect()
        driver.send(driver.observe().position_rad)
        driver.close()
        driver.halt()

    def test_it_ends_all_its_threads(self, driver: Driver, peer: Peer, robot_type: RobotType) -> None:
        """The agent supervises the threads of a driver, and none is left after ``close``."""
        del peer
        before = set(threading.enumerate())
        for _ in range(3):
            driver.connect()
            self.observe(driver, robot_type)
            supervised = {thread.name for thread in threads.watched()}
            unsupervised = {thread.name for thread in set(threading.enumerate()) - before} - supervised
            assert not unsupervised, "start threads with SupervisedThread"
        driver.close()
        self.until(lambda: not set(threading.enumerate()) - before)

    # ------------------------------------------------------------ measurements

    def test_observation_has_every_joint_and_frame(self, connected: Driver, robot_type: RobotType) -> None:
        """All values are finite floats, and not older than the connection."""
        observation = self.observe(connected, robot_type)
        for values in (observation.position_rad, observation.velocity_rad_s, observation.effort_nm):
            assert all(type(value) is float for value in values)
        assert len(observation.frames) == len(robot_type.frames)
        for pose in observation.frames:
            assert all(type(value) is float for value in pose)
            assert math.isclose(math.hypot(*pose[3:]), 1.0, abs_tol=1e-6)
        assert observation.at_s is not None or connected.simulated, "a real device needs the time of its measurement"
        assert observation.at_s is None or observation.at_s <= time.monotonic()

    def test_joints_are_matched_by_name(self, connected: Driver, peer: Peer, robot_type: RobotType) -> None:
        """A device may send them in any order."""
        if self.is_absent(Disturbance.ORDER, connected):
            return
        target = self.nudged(robot_type, connected.observe().position_rad)
        self.move(connected, peer, target, robot_type)
        peer.disturb(Disturbance.ORDER)
        self.reconnect(connected, robot_type)
        assert self.near(self.observe(connected, robot_type).position_rad, target)
        target = self.nudged(robot_type, target)
        self.move(connected, peer, target, robot_type)

    @pytest.mark.parametrize("disturbance", _NO_MEASUREMENT, ids=lambda disturbance: disturbance.value)
    def test_invalid_and_outdated_messages_are_no_measurement(
        self, connected: Driver, peer: Peer, robot_type: RobotType, disturbance: Disturbance
    ) -> None:
        """The device counts as unreachable until it sends valid new values again."""
        if self.is_absent(disturbance, connected):
            return
        before = self.observe(connected, robot_type).position_rad
        peer.disturb(disturbance)
        self.until(lambda: self.lost(connected, robot_type))
        error = self.in_time(connected.connect)
        assert error is None or isinstance(error, DriverError), repr(error)
        assert self.lost(connected, robot_type), "nothing new has arrived"
        peer.restore()
        self.reconnect(connected, robot_type)
        assert self.near(self.observe(connected, robot_type).position_rad, before)

    # ------------------------------------------------------------ commands

    def test_it_does_not_move_after_connect(self, connected: Driver, robot_type: RobotType) -> None:
        """It holds."""
        before = self.observe(connected, robot_type).position_rad
        time.sleep(0.1)
        # Robots on wheels or feet settle by about a millimetre, and their heads move equally.
        assert connected.observe().position_rad == pytest.approx(before, abs=5e-3)

    def test_send_returns_the_applied_values(self, connected: Driver, peer: Peer, robot_type: RobotType) -> None:
        """They are what the device does, not what was requested."""
        now = list(self.observe(connected, robot_type).position_rad)
        now[0] = robot_type.joints[0].upper_rad + 100
        applied = connected.send(now)
        assert applied[0] <= robot_type.joints[0].upper_rad
        assert applied[1:] == pytest.approx(tuple(now[1:]))
        target = self.nudged(robot_type, self.observe(connected, robot_type).position_rad)
        self.move(connected, peer, connected.send(target), robot_type)

    def test_invalid_positions_are_rejected(self, connected: Driver) -> None:
        """The device does not move."""
        before = connected.observe().position_rad
        for invalid in (math.nan, math.inf, -math.inf):
            with pytest.raises(DriverError, match="finite"):
                connected.send([invalid, *before[1:]])
        with pytest.raises(DriverError, match="positions"):
            connected.send([*before, 0.0])
        time.sleep(0.05)
        assert connected.observe().position_rad == pytest.approx(before, abs=1e-2)

    def test_send_moves_the_joints_and_reconnecting_keeps_them(
        self, connected: Driver, peer: Peer, robot_type: RobotType
    ) -> None:
        """Units, signs and order of command and measurement are those of the robot type."""
        target = self.nudged(robot_type, connected.observe().position_rad)
        self.move(connected, peer, target, robot_type)
        connected.close()
        connected.connect()
        assert self.near(connected.observe().position_rad, target)
        assert self.near(peer.joint_positions(), target)

    def test_a_halted_device_holds_and_accepts_commands_only_after_a_reconnect(
        self, connected: Driver, peer: Peer, robot_type: RobotType
    ) -> None:
        """A delayed command of a hanging control loop moves nothing."""
        target = self.nudged(robot_type, connected.observe().position_rad)
        connected.halt()
        connected.halt()
        before = connected.observe().position_rad
        with pytest.raises(DriverError):
            connected.send(target)
        time.sleep(0.05)
        assert connected.observe().position_rad == pytest.approx(before, abs=1e-2)
        connected.connect()
        self.move(connected, peer, target, robot_type)

    # ------------------------------------------------------------ motion without commands

    def test_joints_come_to_rest_without_commands(self, connected: Driver, peer: Peer, robot_type: RobotType) -> None:
        """A watchdog brakes joints that would continue to move."""
        before = self.observe(connected, robot_type).position_rad
        target = self.nudged(robot_type, before)
        self.until(lambda: connected.send(target) and not self.near(peer.joint_positions(), before))
        self.until(lambda: all(abs(value) < _REST_RAD_S for value in peer.joint_velocities()))

    @pytest.mark.parametrize("halted", [False, True])
    def test_a_base_stops_without_commands_and_when_it_is_halted(
        self, connected: Driver, peer: Peer, robot_type: RobotType, *, halted: bool
    ) -> None:
        """A watchdog brakes it."""
        if robot_type.base is None:
            assert not isinstance(connected, MobileDriver) or connected.simulated
            return
        assert isinstance(connected, MobileDriver)
        twist = Twist(forward_m_s=0.5 * robot_type.base.max_linear_m_s)
        home = connected.observe().position_rad
        self.until(lambda: self.drives(connected, peer, twist, home))
        if halted:
            connected.halt()
            with pytest.raises(DriverError):
                connected.drive(twist)
        self.until(lambda: abs(peer.base_twist().forward_m_s) < AT_REST * twist.forward_m_s)
        connected.connect()
        self.until(lambda: self.drives(connected, peer, twist, home))

    # ------------------------------------------------------------ loss of the device

    def test_a_lost_device_is_reported_and_repeats_nothing_when_it_returns(
        self, connected: Driver, peer: Peer, robot_type: RobotType
    ) -> None:
        """The agent connects again; the device stays where it is."""
        if self.is_absent(Disturbance.CONNECTION, connected):
            return
        target = self.nudged(robot_type, connected.observe().position_rad)
        connected.send(target)
        peer.disturb(Disturbance.CONNECTION)
        self.until(lambda: self.lost(connected, robot_type))
        self.until(lambda: isinstance(self.in_time(lambda: connected.send(target)), DriverError))
        for _ in range(2):
            error = self.in_time(connected.connect)
            assert isinstance(error, UnreachableError), repr(error)
            assert self.lost(connected, robot_type)
        self.in_time(connected.halt)
        before = peer.joint_positions()
        peer.restore()
        self.reconnect(connected, robot_type)
        time.sleep(0.1)
        assert self.near(peer.joint_positions(), before)
        self.move(connected, peer, self.nudged(robot_type, before), robot_type)

    def test_a_device_that_stops_itself_is_reported_and_receives_no_commands(
        self, connected: Driver, peer: Peer, robot_type: RobotType
    ) -> None:
        """The agent latches Stop; afterwards it continues at the measured position."""
        if self.is_absent(Disturbance.SAFETY, connected):
            return
        assert isinstance(connected, ReportsFaults)
        assert not [fault for fault in connected.faults() if fault.stops]
        peer.disturb(Disturbance.SAFETY)
        self.until(lambda: any(fault.stops and fault.message for fault in connected.faults()))
        before = self.observe(connected, robot_type).position_rad
        with pytest.raises(DriverError):
            connected.send(self.nudged(robot_type, before))
        connected.connect()
        self.until(lambda: any(fault.stops for fault in connected.faults()))
        peer.restore()
        self.until(lambda: not [fault for fault in connected.faults() if fault.stops])
        time.sleep(0.05)
        assert self.near(peer.joint_positions(), before)
        self.move(connected, peer, self.nudged(robot_type, before), robot_type)

    # ------------------------------------------------------------ live view

    def test_twin_is_a_tree_that_fits_a_retained_message(self, connected: Driver, robot_type: RobotType) -> None:
        """It names every joint of the robot type once."""
        twin = connected.twin()
        if twin is None:
            return
        codec.encode(twin, limit=codec.MAX_RETAINED_BYTES)
        for index, body in enumerate(twin.bodies):
            assert -1 <= body.parent < index
        moved = [body.joint.name for body in twin.bodies if body.joint]
        assert len(moved) == len(set(moved))
        assert {joint.name for joint in robot_type.joints} <= set(moved)
