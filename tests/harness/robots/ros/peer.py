"""The robot and its rosbridge server on loopback, run by one thread."""

import secrets
import threading
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Twist
from device_agent.ports.threads import SupervisedThread
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.robots.ros import robot as topics
from tests.harness.robots.ros.controllers import CYCLE_S, RejectedError
from tests.harness.robots.ros.robot import Robot
from tests.harness.robots.ros.rosbridge_server import RosbridgeServer

_WAIT_S = 60.0
_TRAJECTORY_S = 0.25
_SLOW = 10
"""Other messages than JointState are sent in each tenth cycle."""


class RosPeer:
    """The device of the driver contract. See ``Peer``.

    Args:
        robot_type: Joints, which start at their home positions.
        ros: Version of ROS.
        kind: Kind of the command topic, as in the driver's options.
        stamped: Whether the velocity of the base is a TwistStamped.
        split: Whether the joints have two controllers.
        suffix: Suffix of the joints' names.
        renamed: Other names of topics.
        types: Other types of topics, by their names at the server.
    """

    def __init__(
        self,
        robot_type: RobotType,
        *,
        ros: int = 1,
        kind: str = "trajectory",
        stamped: bool = False,
        split: bool = False,
        suffix: str = "_joint",
        renamed: Mapping[str, str] = MappingProxyType({}),
        types: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._split = split
        self._type, self._ros, self._kind, self._stamped = robot_type, ros, kind, stamped
        self._lock = threading.Lock()
        self._renamed = renamed
        self._original = {name: topic for topic, name in renamed.items()}
        self.robot = Robot(robot_type, ros=ros, kind=kind, stamped=stamped, split=split, suffix=suffix)
        known = {renamed.get(topic, topic): kind for topic, kind in self.robot.types().items()}
        self.server = RosbridgeServer({**known, **types}, self._receive, ros, self._receive_goal)
        self.server.actions[topics.ACTION] = "control_msgs/action/FollowJointTrajectory"
        self.server.latched[topics.SAFETY] = {"data": False}
        self._disturbance: Disturbance | None = None
        self._old_ns = 0
        self._cycles = 0
        self._stopping = threading.Event()
        self._thread = SupervisedThread(self._run, name="peer", part="peer", stopping=self._stopping)
        self._thread.start()

    def options(self) -> dict[str, object]:
        """Options of a driver for this robot."""
        command: dict[str, object] = {"topic": self.robot.command_topic, "kind": self._kind}
        if self._kind == "goal":
            command |= {"topic": topics.ACTION, "rate_hz": 20}
        if self._kind == "positions":
            command["joints"] = self.robot.names[::-1]
        arm = {**command, "joints": self.robot.names[:3]}
        wrist = {"topic": topics.WRIST, "joints": self.robot.names[3:]}
        options: dict[str, object] = {
            "address": f"127.0.0.1:{self.server.port}",
            "ros": self._ros,
            "names": {joint.name: f"{joint.name}_joint" for joint in self._type.joints},
            "command": [arm, wrist] if self._split else command,
            "battery": topics.BATTERY,
            "diagnostics": topics.DIAGNOSTICS,
            "stopping_diagnostics": ["arm"],
            "safety": [{"topic": topics.SAFETY, "type": "std_msgs/Bool", "normal": [False]}],
        }
        if self._type.base is not None:
            options["cameras"] = {camera.name: topics.PICTURES for camera in self._type.cameras}
            options["base"] = {
                "cmd_vel": topics.CMD_VEL,
                "stamped": self._stamped,
                "odometry": topics.ODOMETRY,
                "fixed_frame": "map",
            }
        return options

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self.robot.joints.position[name] for name in self.robot.names)

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        with self._lock:
            return tuple(self.robot.joints.velocity[name] for name in self.robot.names)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        with self._lock:
            return Twist(self.robot.base.forward_m_s, 0.0, self.robot.base.turn_rad_s)

    def disturb(self, disturbance: Disturbance) -> None:
        """See ``Peer``. Returns when the arm rests: its last trajectory ends after the loss of a connection."""
        with self._lock:
            self._disturbance, self._old_ns = disturbance, time.time_ns()
            if disturbance is Disturbance.SAFETY:
                self.robot.stop()
                self._publish_safety()
            if disturbance is Disturbance.CONNECTION:
                self.server.stop()
            started_s = self.robot.joints.time_s
        if disturbance in {Disturbance.SAFETY, Disturbance.CONNECTION}:
            self.wait(lambda robot: robot.joints.time_s > started_s + _TRAJECTORY_S and robot.joints.at_rest)

    def cut(self) -> float:
        """Close all connections and refuse new ones. Returns the robot's time [s]."""
        with self._lock:
            self._disturbance = Disturbance.CONNECTION
            self.server.stop()
            return self.robot.joints.time_s

    def restore(self) -> None:
        """See ``Peer``."""
        with self._lock:
            if self._disturbance is Disturbance.CONNECTION:
                self.server.restart()
            self._disturbance = None
            if self.robot.stopped:
                self.robot.release()
                self._publish_safety()

    def change(self, change: Callable[[Robot, RosbridgeServer], None]) -> None:
        """Change robot and server between two cycles."""
        with self._lock:
            change(self.robot, self.server)

    def wait(self, condition: Callable[[Robot], bool]) -> float:
        """Wait until a condition is true between two cycles. Returns the robot's time then [s]."""
        end_s = time.monotonic() + _WAIT_S
        while time.monotonic() < end_s:
            with self._lock:
                if condition(self.robot):
                    return self.robot.joints.time_s
            time.sleep(CYCLE_S / 4)
        raise TimeoutError

    def close(self) -> None:
        """Switch the device off."""
        self._stopping.set()
        self._thread.join()
        self.server.stop()

    def _receive(self, topic: str, message: Any) -> None:
        try:
            self.robot.receive(self._original.get(topic, topic), message)
        except RejectedError as error:
            self.robot.rejected.append(str(error))

    def _receive_goal(self, number: str, goal: Any) -> None:
        if goal is None:
            self.robot.action.cancel(number)
        else:
            self.robot.start_goal(number, goal)

    def _publish_safety(self) -> None:
        self.server.latched[topics.SAFETY] = {"data": self.robot.stopped}
        self.server.publish(topics.SAFETY, {"data": self.robot.stopped})

    def _run(self) -> None:
        while not self._stopping.wait(CYCLE_S):
            with self._lock:
                self._cycles += 1
                if self._disturbance is not Disturbance.CONNECTION:
                    self.server.step()
                self.robot.step()
                self._publish()

    def _publish(self) -> None:
        kind, robot = self._disturbance, self.robot
        stamp_ns = self._old_ns if kind is Disturbance.CLOCK else time.time_ns()
        message = robot.joint_state(stamp_ns, robot.names[::-1] if kind is Disturbance.ORDER else robot.names)
        if kind is Disturbance.NAN:
            message["position"] = [float("nan")] * len(message["position"])
        self._send(topics.JOINT_STATES, message, self._corrupt)
        for result in robot.results():
            if self._ros == 1:
                self._send(f"{topics.ACTION}/result", result, self._corrupt)
            else:
                self.server.send_result(result)
        if self._cycles % _SLOW:
            return
        self._send(f"{topics.ACTION}/status", robot.status(), self._corrupt)
        self._send(topics.DIAGNOSTICS, robot.diagnostics(), self._corrupt)
        self._send(topics.BATTERY, robot.battery(), self._corrupt)
        self._send(topics.ODOMETRY, robot.odometry(), self._corrupt)
        self._send(topics.PICTURES, robot.picture(), self._corrupt)
        self._send(topics.TF, robot.transforms(), self._corrupt)

    def _send(self, topic: str, message: Any, corrupt: Callable[[bytes], bytes | None]) -> None:
        self.server.publish(self._renamed.get(topic, topic), message, corrupt)

    def _corrupt(self, data: bytes) -> bytes | None:
        if self._disturbance is Disturbance.SILENCE:
            return None
        if self._disturbance is Disturbance.GARBAGE:
            return b"\xff" + secrets.token_bytes(100)
        return data[: len(data) // 2] if self._disturbance is Disturbance.TRUNCATED else data
