"""A robot with ROS: its topics and what they do, in steps of its own time."""

import base64
import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import simplejpeg

from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.robots.ros.controllers import BaseController, JointController, TrajectoryAction

JOINT_STATES, SAFETY, DIAGNOSTICS, BATTERY = "/joint_states", "/emergency_stop", "/diagnostics", "/battery"
CMD_VEL, ODOMETRY, TF = "/cmd_vel", "/odom", "/tf"
PICTURES = "/camera/image_raw/compressed"
COMMAND = "/arm_controller/command"
WRIST = "/wrist_controller/command"
"""Topic of the last three joints, if there are two controllers."""
ACTION = "/arm_controller/follow_joint_trajectory"
_PICTURE = simplejpeg.encode_jpeg(np.full((120, 160, 3), 128, np.uint8))
_COMMANDS = {
    "trajectory": (COMMAND, "trajectory_msgs/JointTrajectory"),
    "positions": (COMMAND, "std_msgs/Float64MultiArray"),
    "joint_state": (COMMAND, "sensor_msgs/JointState"),
    "goal": (f"{ACTION}/goal", "control_msgs/FollowJointTrajectoryActionGoal"),
}
_ROS1 = {"succeeded": 3, "preempted": 2, "aborted": 4, "rejected": 5}
_ROS2 = {"succeeded": 4, "preempted": 5, "aborted": 6}


class Robot:
    """Joints, base, and the messages of both. Its joints have the names of the type with a suffix.

    Attributes:
        stopped: Whether it has stopped itself. It then ignores commands.
        rejected: Commands that a controller did not accept.
    """

    def __init__(self, robot_type: RobotType, *, ros: int, kind: str, stamped: bool, split: bool, suffix: str) -> None:
        self._split = split
        self._ros, self._kind, self._stamped = ros, kind, stamped
        self.names = [f"{joint.name}{suffix}" for joint in robot_type.joints]
        home = [robot_type.home_rad[joint.name] for joint in robot_type.joints]
        self.joints = JointController(dict(zip(self.names, home, strict=True)))
        self.action = TrajectoryAction(self.joints)
        self.base = BaseController()
        self.stopped = False
        self.rejected: list[str] = []
        self.commands = 0

    @property
    def command_topic(self) -> str:
        """Where joint commands arrive."""
        return _COMMANDS[self._kind][0]

    def types(self) -> dict[str, str]:
        """Topic → type of all topics."""
        known = {
            JOINT_STATES: "sensor_msgs/JointState",
            SAFETY: "std_msgs/Bool",
            DIAGNOSTICS: "diagnostic_msgs/DiagnosticArray",
            BATTERY: "sensor_msgs/BatteryState",
            ODOMETRY: "nav_msgs/Odometry",
            TF: "tf2_msgs/TFMessage",
            "/tf_static": "tf2_msgs/TFMessage",
            PICTURES: "sensor_msgs/CompressedImage",
            CMD_VEL: "geometry_msgs/TwistStamped" if self._stamped else "geometry_msgs/Twist",
            self.command_topic: _COMMANDS[self._kind][1],
            WRIST: "trajectory_msgs/JointTrajectory",
            f"{ACTION}/cancel": "actionlib_msgs/GoalID",
            f"{ACTION}/result": "control_msgs/FollowJointTrajectoryActionResult",
            f"{ACTION}/status": "actionlib_msgs/GoalStatusArray",
        }
        return known if self._ros == 1 else {topic: kind.replace("/", "/msg/") for topic, kind in known.items()}

    def receive(self, topic: str, message: Mapping[str, Any]) -> None:
        """Execute a command.

        Raises:
            RejectedError: The controller does not accept it.
        """
        self.commands += 1
        if topic == f"{ACTION}/cancel":
            self.action.cancel(message["id"])
            return
        if self._kind == "goal" and topic != CMD_VEL:
            self.action.start(message["goal_id"]["id"], message["goal"]["trajectory"])
            return
        if self.stopped:
            return
        if topic == CMD_VEL:
            self.base.drive(message["twist"] if self._stamped else message)
        elif self._kind == "positions":
            self.joints.approach(self.names[::-1], message["data"])
        elif self._kind == "joint_state":
            self.joints.approach(message["name"], message["position"])
        else:
            self.joints.follow(message, self.controlled(topic))

    def controlled(self, topic: str) -> list[str]:
        """Joints of the controller with this topic."""
        if not self._split:
            return self.names
        return self.names[3:] if topic == WRIST else self.names[:3]

    def start_goal(self, number: str, goal: Mapping[str, Any]) -> None:
        """Execute a goal of ROS 2."""
        self.commands += 1
        self.action.start(number, goal["trajectory"])

    def stop(self) -> None:
        """Stop itself until ``release``."""
        self.stopped, self.action.enabled = True, False
        self.action.abort(0, "emergency stop")
        self.joints.stop()
        self.base.stop()

    def release(self) -> None:
        """End of ``stop``."""
        self.stopped, self.action.enabled = False, True

    def step(self) -> None:
        """One cycle."""
        self.joints.step()
        self.action.step()
        self.base.step()

    # ------------------------------------------------------------ messages

    def joint_state(self, stamp_ns: int, names: list[str]) -> dict[str, Any]:
        """Measured joints, with a joint that no robot type knows."""
        return {
            "header": {"stamp": self.time(stamp_ns), "frame_id": ""},
            "name": ["gripper_joint", *names],
            "position": [0.3, *(self.joints.position[name] for name in names)],
            "velocity": [0.0, *(self.joints.velocity[name] for name in names)],
            "effort": [math.nan] * (len(names) + 1),
        }

    def diagnostics(self) -> dict[str, Any]:
        """State of the robot's parts."""
        level, text = (2, "emergency stop") if self.stopped else (0, "normal")
        status = {"level": level, "name": "arm: safety", "message": text, "hardware_id": "", "values": []}
        return {"header": {"stamp": self.time(time.time_ns()), "frame_id": ""}, "status": [status]}

    def battery(self) -> dict[str, Any]:
        """State of the battery."""
        return {"voltage": 12.5, "percentage": 0.8, "power_supply_status": 2, "current": math.nan}

    def picture(self) -> dict[str, Any]:
        """A grey picture."""
        return {"format": "jpeg", "data": base64.b64encode(_PICTURE).decode()}

    def odometry(self) -> dict[str, Any]:
        """Pose and velocity of the base."""
        base = self.base
        pose = {"position": {"x": base.x_m, "y": base.y_m, "z": 0.0}, "orientation": _turn(base.yaw_rad)}
        linear, angular = {"x": base.forward_m_s, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": base.turn_rad_s}
        return {"pose": {"pose": pose}, "twist": {"twist": {"linear": linear, "angular": angular}}}

    def transforms(self) -> dict[str, Any]:
        """The base in the map: the origin of the odometry is at (1, 2), turned by 90°."""
        base = self.base
        in_odometry = {"translation": {"x": base.x_m, "y": base.y_m, "z": 0.0}, "rotation": _turn(base.yaw_rad)}
        origin = {"translation": {"x": 1.0, "y": 2.0, "z": 0.0}, "rotation": _turn(math.pi / 2)}
        return {
            "transforms": [
                {"header": {"frame_id": "map"}, "child_frame_id": "odom", "transform": origin},
                {"header": {"frame_id": "odom"}, "child_frame_id": "base_link", "transform": in_odometry},
            ]
        }

    def status(self) -> dict[str, Any]:
        """Status of the action server of ROS 1."""
        return {"header": {"stamp": self.time(time.time_ns()), "frame_id": ""}, "status_list": []}

    def results(self) -> list[dict[str, Any]]:
        """Results of the goals that have ended, for ROS 1; for ROS 2 without ``op``."""
        ended, self.action.ended = self.action.ended, []
        results: list[dict[str, Any]] = []
        for number, outcome, code, text in ended:
            result = {"error_code": code, "error_string": text}
            if self._ros == 1:
                state: dict[str, Any] = {
                    "goal_id": {"stamp": self.time(0), "id": number},
                    "status": _ROS1[outcome],
                    "text": text,
                }
                results.append({"status": state, "result": result})
            elif outcome == "rejected":
                results.append({"action": ACTION, "id": number, "values": text, "status": 0, "result": False})
            else:
                row = {"action": ACTION, "id": number, "values": result, "status": _ROS2[outcome], "result": True}
                results.append(row)
        return results

    def time(self, stamp_ns: int) -> dict[str, int]:
        """A time as a message."""
        fields = ("secs", "nsecs") if self._ros == 1 else ("sec", "nanosec")
        return dict(zip(fields, divmod(stamp_ns, 10**9), strict=True))


def _turn(yaw_rad: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw_rad / 2), "w": math.cos(yaw_rad / 2)}
