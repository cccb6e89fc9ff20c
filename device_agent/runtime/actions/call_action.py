"""Actions that are one call: what an operator orders, and what a script asks of its robot, are the same deeds."""

from collections.abc import Collection
from typing import Any

from msgspec import Struct, structs

from device_agent import protocol
from device_agent.ports import script_calls
from device_agent.protocol import Task
from device_agent.runtime.actions.robot_api import RobotApi

_CALLS: dict[type[Struct], type[script_calls.Call]] = {
    protocol.MoveJoints: script_calls.MoveJoints,
    protocol.MovePose: script_calls.MoveTo,
    protocol.Say: script_calls.Say,
    protocol.Express: script_calls.Express,
    protocol.TakePosture: script_calls.Posture,
    protocol.RunBehaviour: script_calls.Behaviour,
    protocol.SetStiffness: script_calls.Stiffness,
    protocol.LookAt: script_calls.Look,
    protocol.Drive: script_calls.Drive,
    protocol.GoTo: script_calls.GoTo,
}
"""Order → the call of a script that asks the same, with fields of the same names."""


def call(order: Task) -> script_calls.Call:
    """The call that does what is ordered."""
    return _CALLS[type(order)](**structs.asdict(order))


def kinds(can: Collection[str]) -> tuple[str, ...]:
    """The kinds of order that a robot with these calls takes."""
    return tuple(_tag(order) for order, call in _CALLS.items() if _tag(call) in can)


def _tag(kind: type[Struct]) -> str:
    return str(kind.__struct_config__.tag)


class CallAction:
    """An activity that is one call; losing the device ends it.

    Args:
        order: What is asked.
        robot: Who does it.
    """

    def __init__(self, order: Task, robot: RobotApi) -> None:
        self._call = call(order)
        self._robot = robot

    def run(self) -> dict[str, Any]:
        """Do it to its end; gives what limited it."""
        done = self._robot.do(self._call)
        result: dict[str, Any] = done if isinstance(done, dict) else {}
        limited = self._robot.limited
        return result | {"limited": limited} if limited else result

    def kill(self) -> None:
        """The robot has been told already."""
