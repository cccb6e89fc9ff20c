"""Joint positions of the expressions and postures in a robot type's manifest."""

from collections.abc import Mapping
from typing import TypeVar

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused

EXPRESSION_SPEED = 0.5
"""Share of each joint's velocity limit for expressions: a face that snaps is unpleasant to watch."""

T = TypeVar("T")


def expression(robot_type: RobotType, name: str, strength: float) -> dict[str, float]:
    """Joint positions of an expression, scaled by ``strength`` from home [rad].

    Joints that only other expressions move return home, so that expressions do not mix.

    Raises:
        Refused: The expression is unknown.
    """
    positions_rad = find("expression", name, robot_type.expressions)
    moved = {joint for positions in robot_type.expressions.values() for joint in positions}
    home_rad = robot_type.home_rad
    return {
        joint: home_rad[joint] + strength * (positions_rad.get(joint, home_rad[joint]) - home_rad[joint])
        for joint in home_rad
        if joint in moved
    }


def posture(robot_type: RobotType, name: str) -> dict[str, float]:
    """Joint positions of a posture [rad].

    Raises:
        Refused: The posture is unknown.
    """
    return find("posture", name, robot_type.postures)


def find(kind: str, name: str, items: Mapping[str, T]) -> T:
    """The item with this name.

    Raises:
        Refused: The name is unknown; the text lists the valid names.
    """
    item = items.get(name)
    if item is None:
        raise Refused(f"unknown_{kind}", f"no {kind} '{name[:80]}'; there are {', '.join(items) or 'none'}")
    return item
