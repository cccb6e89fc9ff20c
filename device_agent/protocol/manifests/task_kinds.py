"""Kinds of actions that follow from a robot type. The agent's description and the cloud's catalogue use this list."""

from collections.abc import Collection
from typing import get_args

from msgspec import StructMeta

from device_agent.protocol.commands import (
    Drive,
    Express,
    GoTo,
    LookAt,
    MoveJoints,
    MovePose,
    RobotTask,
    RunBehaviour,
    Say,
    SetStiffness,
    TakePosture,
)
from device_agent.protocol.manifests.robot_type import RobotType

SPEECH, STIFFNESS, GAZE, EXPRESSIONS, BEHAVIOURS = "speech", "stiffness", "gaze", "expressions", "behaviours"
POSTURES, CARTESIAN = "postures", "cartesian"
"""Capabilities of manifests that allow actions."""


def tasks_of(
    robot_type: RobotType, *, performed: Collection[str], has_model: bool, has_map: bool, has_behaviours: bool = False
) -> tuple[type[RobotTask], ...]:
    """Types of the actions that a robot supports.

    Args:
        robot_type: Its type.
        performed: Capabilities that its driver executes itself.
        has_model: Whether the shape of the robot is known.
        has_map: Whether sensors of the room publish an obstacle map.
        has_behaviours: Whether the robot itself may provide behaviours.
    """
    named = set(robot_type.capabilities)
    by_driver = named.intersection(performed)
    has: dict[type[RobotTask], bool] = {
        MoveJoints: bool(robot_type.joints),
        MovePose: CARTESIAN in named and has_model,
        Say: SPEECH in named,
        Express: EXPRESSIONS in by_driver or bool(robot_type.expressions),
        TakePosture: POSTURES in by_driver or bool(robot_type.postures),
        RunBehaviour: has_behaviours or BEHAVIOURS in by_driver or bool(robot_type.behaviours),
        SetStiffness: STIFFNESS in by_driver,
        LookAt: GAZE in by_driver or (robot_type.gaze is not None and has_model),
        Drive: robot_type.base is not None,
        GoTo: robot_type.base is not None and has_map,
    }
    return tuple(task for task in get_args(RobotTask) if has[task])


def kinds_of(robot_type: RobotType) -> tuple[str, ...]:
    """Kinds of the actions that a robot of this type supports with a complete driver, in a room with a map."""
    tasks = tasks_of(robot_type, performed=robot_type.capabilities, has_model=bool(robot_type.model), has_map=True)
    return tuple(map(tag, tasks))


def tag(message: StructMeta) -> str:
    """The ``kind`` of a message type."""
    return str(message.__struct_config__.tag)
