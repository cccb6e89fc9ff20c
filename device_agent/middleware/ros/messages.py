"""Messages of ROS 1 and ROS 2 in the JSON form of rosbridge.

Source: *rosbridge v2.0 Protocol Specification*; message definitions of ``common_msgs`` and ``common_interfaces``.
Both versions are accepted; ``Dialect`` writes one of them. Values that are not finite arrive as ``null``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct

NS = 1_000_000_000
Message = dict[str, Any]


class Time(Struct, frozen=True):
    """A time: ``secs`` and ``nsecs`` in ROS 1, ``sec`` and ``nanosec`` in ROS 2."""

    secs: int = 0
    nsecs: int = 0
    sec: int = 0
    nanosec: int = 0

    @property
    def ns(self) -> int:
        """Nanoseconds since the epoch of the robot's clock."""
        return (self.secs + self.sec) * NS + self.nsecs + self.nanosec


class Header(Struct, frozen=True):
    """``std_msgs/Header``."""

    stamp: Time = Time()
    frame_id: str = ""


class JointState(Struct, frozen=True):
    """``sensor_msgs/JointState``. Velocities and efforts may be missing."""

    header: Header
    name: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float | None, ...] = ()
    effort: tuple[float | None, ...] = ()


class Vector3(Struct, frozen=True):
    """``geometry_msgs/Vector3`` and ``Point``."""

    x: float
    y: float
    z: float


class Quaternion(Struct, frozen=True):
    """``geometry_msgs/Quaternion``."""

    x: float
    y: float
    z: float
    w: float


class Pose(Struct, frozen=True):
    """``geometry_msgs/Pose``."""

    position: Vector3
    orientation: Quaternion


class PoseWithCovariance(Struct, frozen=True):
    """``geometry_msgs/PoseWithCovariance`` without its covariance."""

    pose: Pose


class Twist(Struct, frozen=True):
    """``geometry_msgs/Twist``."""

    linear: Vector3
    angular: Vector3


class TwistWithCovariance(Struct, frozen=True):
    """``geometry_msgs/TwistWithCovariance`` without its covariance."""

    twist: Twist


class Odometry(Struct, frozen=True):
    """``nav_msgs/Odometry``. The twist is in the frame of the base."""

    pose: PoseWithCovariance
    twist: TwistWithCovariance


class Transform(Struct, frozen=True):
    """``geometry_msgs/Transform``."""

    translation: Vector3
    rotation: Quaternion


class TransformStamped(Struct, frozen=True):
    """``geometry_msgs/TransformStamped``: pose of the child in the header's frame."""

    header: Header
    child_frame_id: str
    transform: Transform


class Transforms(Struct, frozen=True):
    """``tf2_msgs/TFMessage``."""

    transforms: tuple[TransformStamped, ...]


class BatteryState(Struct, frozen=True):
    """``sensor_msgs/BatteryState``. ``percentage`` is a share, 0…1."""

    voltage: float | None = None
    percentage: float | None = None
    power_supply_status: int = 0


class CompressedImage(Struct, frozen=True):
    """``sensor_msgs/CompressedImage``. The data are Base64 in JSON."""

    data: bytes


class GoalId(Struct, frozen=True):
    """``actionlib_msgs/GoalID``."""

    id: str


class GoalStatus(Struct, frozen=True):
    """``actionlib_msgs/GoalStatus`` of ROS 1."""

    goal_id: GoalId
    status: int
    text: str = ""


class GoalStatuses(Struct, frozen=True):
    """``actionlib_msgs/GoalStatusArray``. An action server of ROS 1 publishes it regularly."""

    status_list: tuple[GoalStatus, ...]


class TrajectoryResult(Struct, frozen=True):
    """``control_msgs/FollowJointTrajectoryResult``. ``error_code`` is 0 after a successful motion."""

    error_code: int = 0
    error_string: str = ""


class TrajectoryActionResult(Struct, frozen=True):
    """``control_msgs/FollowJointTrajectoryActionResult`` of ROS 1."""

    status: GoalStatus
    result: TrajectoryResult


class DiagnosticStatus(Struct, frozen=True):
    """``diagnostic_msgs/DiagnosticStatus``. Level: 0 OK, 1 warning, 2 error, 3 outdated."""

    level: int
    name: str
    message: str = ""


class DiagnosticArray(Struct, frozen=True):
    """``diagnostic_msgs/DiagnosticArray``."""

    status: tuple[DiagnosticStatus, ...]


class Dialect:
    """Writes messages for one version of ROS.

    Args:
        ros: 1 or 2.

    Attributes:
        ros: 1 or 2.
    """

    def __init__(self, ros: int) -> None:
        self.ros = ros

    def type(self, name: str) -> str:
        """Name of a message type: ``sensor_msgs/JointState`` is ``sensor_msgs/msg/JointState`` in ROS 2."""
        package, _, message = name.replace("/msg/", "/").partition("/")
        return name if self.ros == 1 else f"{package}/msg/{message}"

    def time(self, time_s: float) -> Message:
        """A time or duration [s]."""
        seconds, nanoseconds = divmod(round(time_s * NS), NS)
        names = ("secs", "nsecs") if self.ros == 1 else ("sec", "nanosec")
        return dict(zip(names, (seconds, nanoseconds), strict=True))

    def trajectory(self, names: Sequence[str], position_rad: Sequence[float], duration_s: float) -> Message:
        """A ``JointTrajectory`` to rest at a position, which starts when it arrives."""
        point = {
            "positions": list(position_rad),
            "velocities": [0.0] * len(names),
            "accelerations": [],
            "effort": [],
            "time_from_start": self.time(duration_s),
        }
        header = {"stamp": self.time(0.0), "frame_id": ""}
        return {"header": header, "joint_names": list(names), "points": [point]}

    def goal(self, trajectory: Message) -> Message:
        """A ``FollowJointTrajectoryGoal``."""
        tolerances: Message = {"path_tolerance": [], "goal_tolerance": []}
        return {"trajectory": trajectory, **tolerances, "goal_time_tolerance": self.time(0.0)}


def twist(linear: Sequence[float], turn_rad_s: float) -> Message:
    """A ``Twist`` of a base: forward and left [m/s], and the turn [rad/s]."""
    forward, left = linear
    return {"linear": {"x": forward, "y": left, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": turn_rad_s}}


def value_of(message: Mapping[str, Any], field: str) -> Any:
    """A field of any message, with dots for nested fields.

    Raises:
        ValueError: The message has no such field.
    """
    found: Any = message
    for name in field.split("."):
        if not isinstance(found, Mapping) or name not in found:
            raise ValueError(f"the message has no field '{field}'")
        found = found[name]
    return found
