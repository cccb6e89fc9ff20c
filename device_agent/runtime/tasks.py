"""Actions that are one call: what an operator orders, and what a script asks of its robot, are the same deeds."""

from collections.abc import Collection
from typing import Any

from msgspec import Struct, structs

from device_agent.protocol import messages
from device_agent.protocol.messages import Task
from device_agent.runtime import calls
from device_agent.runtime.robot import ScriptRobot

_CALLS: dict[type[Struct], type[calls.Call]] = {
    messages.MoveJoints: calls.MoveJoints,
    messages.MovePose: calls.MoveTo,
    messages.Say: calls.Say,
    messages.Express: calls.Express,
    messages.TakePosture: calls.Posture,
    messages.RunBehaviour: calls.Behaviour,
    messages.SetStiffness: calls.Stiffness,
    messages.LookAt: calls.Look,
    messages.Drive: calls.Drive,
    messages.GoTo: calls.GoTo,
}
"""Order → the call of a script that asks the same, with fields of the same names."""


def call(order: Task) -> calls.Call:
    """The call that does what is ordered."""
    return _CALLS[type(order)](**structs.asdict(order))


def kinds(can: Collection[str]) -> tuple[str, ...]:
    """The kinds of order that a robot with these calls takes."""
    return tuple(_tag(order) for order, call in _CALLS.items() if _tag(call) in can)


def _tag(kind: type[Struct]) -> str:
    return str(kind.__struct_config__.tag)


class Deed:
    """An activity that is one call; losing the device ends it.

    Args:
        order: What is asked.
        robot: Who does it.
    """

    def __init__(self, order: Task, robot: ScriptRobot) -> None:
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
