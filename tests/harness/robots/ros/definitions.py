"""Definitions of the messages that a driver publishes. rosbridge rejects messages with other fields or types."""

from collections.abc import Mapping
from typing import Any

_TIME = {1: ("secs", "nsecs"), 2: ("sec", "nanosec")}
_PRIMITIVES: Mapping[str, type | tuple[type, ...]] = {
    "float64": (int, float), "uint32": int, "string": str, "bool": bool,
}  # fmt: skip
_DEFINITIONS: Mapping[str, Mapping[str, str]] = {
    "std_msgs/Header": {"stamp": "time", "frame_id": "string"},
    "std_msgs/String": {"data": "string"},
    "std_msgs/Float64MultiArray": {"layout": "std_msgs/MultiArrayLayout", "data": "float64[]"},
    "std_msgs/MultiArrayLayout": {"dim": "std_msgs/MultiArrayDimension[]", "data_offset": "uint32"},
    "sensor_msgs/JointState": {
        "header": "std_msgs/Header", "name": "string[]", "position": "float64[]", "velocity": "float64[]",
        "effort": "float64[]",
    },
    "trajectory_msgs/JointTrajectory": {
        "header": "std_msgs/Header", "joint_names": "string[]", "points": "trajectory_msgs/JointTrajectoryPoint[]",
    },
    "trajectory_msgs/JointTrajectoryPoint": {
        "positions": "float64[]", "velocities": "float64[]", "accelerations": "float64[]", "effort": "float64[]",
        "time_from_start": "time",
    },
    "control_msgs/FollowJointTrajectoryActionGoal": {
        "header": "std_msgs/Header", "goal_id": "actionlib_msgs/GoalID",
        "goal": "control_msgs/FollowJointTrajectoryGoal",
    },
    "actionlib_msgs/GoalID": {"stamp": "time", "id": "string"},
    "control_msgs/FollowJointTrajectoryGoal": {
        "trajectory": "trajectory_msgs/JointTrajectory", "path_tolerance": "control_msgs/JointTolerance[]",
        "goal_tolerance": "control_msgs/JointTolerance[]", "goal_time_tolerance": "time",
    },
    "geometry_msgs/Vector3": {"x": "float64", "y": "float64", "z": "float64"},
    "geometry_msgs/Twist": {"linear": "geometry_msgs/Vector3", "angular": "geometry_msgs/Vector3"},
    "geometry_msgs/TwistStamped": {"header": "std_msgs/Header", "twist": "geometry_msgs/Twist"},
}  # fmt: skip


class FieldError(Exception):
    """A message does not match its type."""


def check(message: Any, kind: str, ros: int) -> None:
    """Check a message.

    Raises:
        FieldError: It has a field that the type lacks, or a value of another type.
    """
    if kind.endswith("[]"):
        if not isinstance(message, list):
            raise FieldError(f"{kind} expected")
        for each in message:
            check(each, kind[:-2], ros)
    elif kind == "time":
        if set(message) - set(_TIME[ros]) or not all(isinstance(value, int) for value in message.values()):
            raise FieldError(f"{message} is no time of ROS {ros}")
    elif kind in _PRIMITIVES:
        if not isinstance(message, _PRIMITIVES[kind]) or isinstance(message, bool) is not (kind == "bool"):
            raise FieldError(f"{message!r} is no {kind}")
    else:
        for field, value in message.items():
            if field not in _DEFINITIONS[kind]:
                raise FieldError(f"{kind} has no field {field}")
            check(value, _DEFINITIONS[kind][field], ros)
