"""The robot of ``rospy_robot.py`` as the device of the driver contract."""

from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.network.proxy import Proxy
from tests.harness.robots.ros.ros_system import RosRobot, RosSystem

ACTION = "/arm_controller/follow_joint_trajectory"


class RospyPeer:
    """See ``Peer``. The driver reaches the master through a proxy, which can cut the connection.

    Args:
        system: Master.
        robot: The robot, which is shared by tests.
        robot_type: Its joints and base.
        proxy: In front of the master.
        kind: Kind of command, as in the driver's options.
    """

    def __init__(self, system: RosSystem, robot: RosRobot, robot_type: RobotType, proxy: Proxy, kind: str) -> None:
        self._system, self.robot, self._type, self._proxy, self._kind = system, robot, robot_type, proxy, kind
        self.robot.request(restore=True, reset=True)

    def options(self) -> dict[str, object]:
        """Options of a driver for this robot."""
        options: dict[str, object] = {
            "connection": "rospy",
            "master": f"http://127.0.0.1:{self._proxy.port}",
            "python_folders": [str(self._system.messages)],
            "names": {joint.name: f"{joint.name}_joint" for joint in self._type.joints},
            "command": {"topic": "/arm_controller/command"},
            "safety": [{"topic": "/emergency_stop", "type": "std_msgs/Bool", "normal": [False]}],
        }
        if self._kind == "goal":
            options["command"] = {"topic": ACTION, "kind": "goal", "rate_hz": 20}
        if self._type.base is not None:
            options["base"] = {"cmd_vel": "/cmd_vel", "odometry": "/odom"}
        return options

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        return tuple(self.robot.positions())

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        velocity = self.robot.state()["velocity"]
        return tuple(velocity[name] for name in self.robot.names)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        state = self.robot.state()
        return Twist(state["forward_m_s"], 0.0, state["turn_rad_s"])

    def disturb(self, disturbance: Disturbance) -> None:
        """See ``Peer``."""
        if disturbance is Disturbance.CONNECTION:
            self._proxy.refuse()
        else:
            self.robot.request(disturb=disturbance.value)

    def restore(self) -> None:
        """See ``Peer``."""
        self._proxy.admit()
        self.robot.request(restore=True)
