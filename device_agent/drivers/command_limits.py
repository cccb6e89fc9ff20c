"""Checks commands before a driver sends them, and applies the limits of the robot type."""

import math
from collections.abc import Sequence

from device_agent.ports.driver import DriverError, Twist
from device_agent.protocol.manifests.robot_type import RobotType


def limit_positions(robot_type: RobotType, position_rad: Sequence[float]) -> tuple[float, ...]:
    """Commanded positions within the limits of the joints [rad], in the order of ``robot_type.joints``.

    Raises:
        DriverError: The number of positions is wrong, or one is not finite.
    """
    joints = robot_type.joints
    if len(position_rad) != len(joints):
        raise DriverError(f"{len(position_rad)} positions for {len(joints)} joints")
    if not all(map(math.isfinite, position_rad)):
        raise DriverError("a commanded position is not finite")
    return tuple(
        min(max(value, joint.lower_rad), joint.upper_rad) for value, joint in zip(position_rad, joints, strict=True)
    )


def limit_twist(robot_type: RobotType, twist: Twist) -> Twist:
    """A commanded velocity within the limits of the base [m/s, rad/s].

    Raises:
        DriverError: A value is not finite, or the robot type has no base.
    """
    if not all(map(math.isfinite, twist)):
        raise DriverError("a commanded twist is not finite")
    base = robot_type.base
    if base is None:
        raise DriverError(f"robot type '{robot_type.type}' has no base")
    limits = (base.max_linear_m_s, base.max_linear_m_s * base.sideways, base.max_angular_rad_s)
    return Twist(*(min(max(value, -limit), limit) for value, limit in zip(twist, limits, strict=True)))
