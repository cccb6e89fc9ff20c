"""What a robot type's manifest says how to show: where the joints have to be."""

from collections.abc import Mapping
from typing import TypeVar

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused

EXPRESSION_SPEED = 0.5
"""Share of each joint's velocity limit with which an expression comes: a face that snaps frightens."""

T = TypeVar("T")


def expression(robot_type: RobotType, name: str, strength: float) -> dict[str, float]:
    """Joint positions of an expression, so much of the way from home [rad].

    Joints that only other expressions move are brought home: a smile must not be left in a frown.

    Raises:
        Refused: There is no such expression.
    """
    shown = named("expression", name, robot_type.expressions)
    moved = {joint for positions in robot_type.expressions.values() for joint in positions}
    home_rad = robot_type.home_rad
    return {
        joint: home_rad[joint] + strength * (shown.get(joint, home_rad[joint]) - home_rad[joint])
        for joint in home_rad
        if joint in moved
    }


def posture(robot_type: RobotType, name: str) -> dict[str, float]:
    """Joint positions of a posture [rad].

    Raises:
        Refused: There is no such posture.
    """
    return named("posture", name, robot_type.postures)


def named(word: str, name: str, there: Mapping[str, T]) -> T:
    """One of several things that have names.

    Raises:
        Refused: There is no such thing; the text lists what there is.
    """
    found = there.get(name)
    if found is None:
        raise Refused(f"unknown_{word}", f"no {word} '{name[:80]}'; there are {', '.join(there) or 'none'}")
    return found
