"""Options of the driver ``ros``: ``[devices.options]``. They map topics; nothing about a robot is in the code."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from device_agent.middleware.ros.endpoint import Endpoint
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests.robot_type import RobotType

Topic = Annotated[str, Meta(pattern=r"^[/~A-Za-z][A-Za-z0-9_/]*$", max_length=200)]
OptionalTopic = Annotated[str, Meta(pattern=r"^([/~A-Za-z][A-Za-z0-9_/]*)?$", max_length=200)]


class Command(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where joint commands of one controller are published.

    Attributes:
        topic: Topic; for ``goal`` the name of the action.
        kind: ``trajectory``: JointTrajectory. ``positions``: Float64MultiArray. ``joint_state``: JointState. ``goal``:
            FollowJointTrajectory.
        joints: ROS names of the controller's joints. It is required for ``positions``, whose messages have no names,
            in the controller's order, and if there are several controllers.
        horizon_ms: Duration of each trajectory [ms]. The arm comes to rest after this time without commands.
        rate_hz: Commands per second, at most one in each control period [Hz].
    """

    topic: Topic
    kind: Literal["trajectory", "positions", "joint_state", "goal"] = "trajectory"
    joints: tuple[str, ...] = ()
    horizon_ms: Annotated[int, Meta(ge=40, le=250)] = 100
    rate_hz: Annotated[float, Meta(ge=1, le=500)] = 50.0


class Base(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics of a mobile base.

    Attributes:
        cmd_vel: Topic of commanded velocities.
        stamped: Whether its type is TwistStamped, not Twist.
        odometry: Topic of Odometry; empty for none.
        fixed_frame: Frame in which ``tf`` gives the pose of ``base_frame``; empty: the pose of ``odometry`` is used.
        base_frame: Frame of the base.
    """

    cmd_vel: Topic
    stamped: bool = False
    odometry: OptionalTopic = ""
    fixed_frame: str = ""
    base_frame: str = "base_link"


class Safety(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A topic that tells whether the robot may move, for example a safety mode or an emergency stop.

    Attributes:
        topic: The topic.
        type: Its type: ``std_msgs/Bool``.
        field: Field of the message, with dots for nested fields.
        normal: Values with which the robot may move. With every other value it has stopped itself.
    """

    topic: Topic
    type: Annotated[str, Meta(pattern=r"^\w+/(msg/)?\w+$")]
    field: str = "data"
    normal: Annotated[tuple[bool | int | str, ...], Meta(min_length=1)]


class RawCamera(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera without JPEGs.

    Attributes:
        raw: Topic of Image: colours, or depths for display.
    """

    raw: Topic


class Options(Endpoint, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All options, with those of ``Endpoint``.

    Attributes:
        joint_states: Topic of JointState.
        names: Joint of the robot type → name of the joint in ROS; only for those that differ.
        command: Where joint commands are published: one controller, or several that have different joints.
        base: Topics of a mobile base.
        cameras: Camera of the robot type → topic of CompressedImage with JPEGs, or a raw camera.
        scans: Stream of the robot type → topic of LaserScan.
        battery: Topic of BatteryState; empty for none.
        diagnostics: Topic of DiagnosticArray; empty for none.
        stopping_diagnostics: Beginnings of names in the diagnostics. With an error of such a part the robot stops.
        safety: Topics that tell whether the robot may move.
    """

    joint_states: Topic = "/joint_states"
    names: dict[str, str] = msgspec.field(default_factory=dict)
    command: Command | Annotated[tuple[Command, ...], Meta(min_length=1, max_length=8)]
    base: Base | None = None
    cameras: dict[str, Topic | RawCamera] = msgspec.field(default_factory=dict)
    scans: dict[str, Topic] = msgspec.field(default_factory=dict)
    battery: OptionalTopic = ""
    diagnostics: OptionalTopic = ""
    stopping_diagnostics: tuple[str, ...] = ()
    safety: Annotated[tuple[Safety, ...], Meta(max_length=8)] = ()

    @property
    def controllers(self) -> tuple[Command, ...]:
        """The controllers of the joints."""
        return (self.command,) if isinstance(self.command, Command) else self.command


def parse(options: Mapping[str, object], robot_type: RobotType) -> Options:
    """Check the options of one device.

    Raises:
        DriverError: An option is unknown, missing or wrong; the message names it.
    """
    for name in options:
        if name not in Options.__struct_fields__:
            valid = ", ".join(Options.__struct_fields__)
            raise DriverError(f"driver 'ros' has no option '{name}'; it has: {valid}")
    try:
        parsed = msgspec.convert(options, Options)
    except msgspec.ValidationError as error:
        raise DriverError(f"options of driver 'ros': {error}") from error
    _check(parsed, robot_type)
    return parsed


def _check(options: Options, robot_type: RobotType) -> None:
    joints = [joint.name for joint in robot_type.joints]
    cameras = [camera.name for camera in robot_type.cameras]
    streams = [stream.name for stream in robot_type.streams]
    named: tuple[tuple[str, Mapping[str, object], list[str]], ...] = (
        ("names", options.names, joints),
        ("cameras", options.cameras, cameras),
        ("scans", options.scans, streams),
    )
    for option, used, known in named:
        unknown = sorted(set(used) - set(known))
        if unknown:
            valid = ", ".join(known) or "none"
            raise DriverError(
                f"option '{option}': robot type '{robot_type.type}' has no '{unknown[0]}'; it has: {valid}"
            )
    names = [options.names.get(joint, joint) for joint in joints]
    if len(set(names)) != len(names):
        raise DriverError("option 'names': two joints have the same name in ROS")
    _check_joints(options.controllers, names)
    for command in options.controllers:
        _check_rate(command, robot_type)
    if options.contradiction:
        raise DriverError(options.contradiction)
    if (options.base is None) != (robot_type.base is None):
        raise DriverError(f"option 'base' is for robot types with a base; '{robot_type.type}' and the options differ")


def _check_joints(controllers: Sequence[Command], names: Sequence[str]) -> None:
    for command in controllers:
        if not command.joints and (command.kind == "positions" or len(controllers) > 1):
            raise DriverError(
                f"option 'command.joints' must list the joints of {command.topic} in the controller's order; "
                f"joints: {', '.join(names)}"
            )
    listed = [name for command in controllers for name in command.joints or names]
    if sorted(listed) != sorted(names):
        wrong = sorted({name for name in names if listed.count(name) != 1} | (set(listed) - set(names)))
        raise DriverError(
            f"option 'command.joints': each joint must be listed once, by its name in ROS; check {', '.join(wrong)}"
        )
    topics = [command.topic.rstrip("/") for command in controllers]
    if len(set(topics)) != len(topics):
        raise DriverError("option 'command': two controllers have the same topic")


def _check_rate(command: Command, robot_type: RobotType) -> None:
    if command.horizon_ms < 2 * max(robot_type.period_ms, 1000 / command.rate_hz):
        raise DriverError(
            "option 'command.horizon_ms' must be at least two command intervals: "
            f"two periods of the robot type ({robot_type.period_ms} ms), and twice 1/rate_hz"
        )
