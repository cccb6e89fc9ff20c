"""The driver for ROS fulfils the driver contract: behind an emulated rosbridge server, and with ROS 1 of Debian."""

from collections.abc import Iterator

import pytest

from device_agent import drivers
from device_agent.drivers.ros import driver as ros_driver
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.ports.driver import Driver
from device_agent.protocol.manifests import robot_type as robot_types
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.network.proxy import Proxy, start_proxy
from tests.harness.paths import ROBOTS
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.ros_system import RosRobot, RosSystem, ros_system
from tests.harness.robots.ros.rospy_peer import RospyPeer

REST_S = 0.35
"""A horizon, and the delay of the joints [s]."""


class TestRos1Arm(DriverContract):
    """An arm with a trajectory controller."""

    type_name = "ur5"
    ros, kind, stamped, split = 1, "trajectory", False, False

    @pytest.fixture(autouse=True)
    def _short_start(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(ros_driver, "_START_S", 1.0)

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(ROBOTS / self.type_name)

    @pytest.fixture
    def peer(self, robot_type: RobotType) -> Iterator[RosPeer]:
        peer = RosPeer(robot_type, ros=self.ros, kind=self.kind, stamped=self.stamped, split=self.split)
        yield peer
        peer.close()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: RosPeer) -> Iterator[Driver]:
        driver = drivers.load("ros")(robot_type, ROBOTS / self.type_name, peer.options(), "robot")
        yield driver
        driver.close()
        assert not peer.server.errors
        assert not peer.robot.rejected

    def test_a_motion_ends_in_time_after_a_cut(self, connected: Driver, peer: RosPeer) -> None:
        """The last trajectory is short, so a lost agent moves nothing for long."""
        target = [value + 0.5 for value in peer.joint_positions()]
        self.until(lambda: connected.send(target) and max(map(abs, peer.joint_velocities())) > 0.5)
        cut_s = peer.cut()
        assert peer.wait(lambda robot: robot.joints.at_rest) - cut_s <= REST_S


class TestRos2Base(TestRos1Arm):
    """A robot on wheels with a head."""

    type_name = "qbo"
    ros, stamped = 2, True


@pytest.mark.long
class TestTwoControllers(TestRos1Arm):
    """An arm whose joints belong to two trajectory controllers."""

    split = True


@pytest.mark.long
class TestPositionController(TestRos1Arm):
    """A controller that follows positions."""

    kind = "positions"


@pytest.mark.long
class TestJointStateCommands(TestRos1Arm):
    """A controller that takes JointState."""

    kind = "joint_state"


@pytest.mark.long
class TestActionGoals(TestRos1Arm):
    """An action server for FollowJointTrajectory."""

    kind = "goal"


@pytest.mark.long
class TestRos2ActionGoals(TestRos1Arm):
    """An action server of ROS 2 for FollowJointTrajectory."""

    ros, kind = 2, "goal"


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSystem]:
    with ros_system(tmp_path_factory.mktemp("ros")) as system:
        yield system


@pytest.fixture(scope="module")
def proxy(system: RosSystem) -> Iterator[Proxy]:
    with start_proxy(system.port) as proxy:
        yield proxy


class TestRospyBase(DriverContract):
    """A robot on wheels with a head, in a graph with a real master, through ``rospy``."""

    type_name = "qbo"
    kind = "trajectory"

    @pytest.fixture(autouse=True)
    def _short_start(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(ros_driver, "_START_S", 2.0)

    @pytest.fixture(scope="class")
    @classmethod
    def robot(cls, system: RosSystem) -> Iterator[RosRobot]:
        robot = RosRobot(system, robot_types.load(ROBOTS / cls.type_name))
        yield robot
        robot.kill()

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_types.load(ROBOTS / self.type_name)

    @pytest.fixture
    def peer(self, system: RosSystem, robot: RosRobot, robot_type: RobotType, proxy: Proxy) -> Iterator[RospyPeer]:
        peer = RospyPeer(system, robot, robot_type, proxy, self.kind)
        yield peer
        peer.restore()

    @pytest.fixture
    def driver(self, robot_type: RobotType, peer: RospyPeer) -> Iterator[Driver]:
        driver = drivers.load("ros")(robot_type, ROBOTS / self.type_name, peer.options(), "robot")
        yield driver
        driver.close()


@pytest.mark.long
class TestRospyArm(TestRospyBase):
    """An arm with a trajectory controller."""

    type_name = "ur5"


@pytest.mark.long
class TestRospyGoals(TestRospyBase):
    """An arm with an action server of ``actionlib``."""

    type_name, kind = "ur5", "goal"
