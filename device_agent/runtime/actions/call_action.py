"""An action that is one ``RobotApi`` call."""

from typing import Any

from device_agent.protocol import RobotTask
from device_agent.runtime.actions.robot_api import RobotApi


class CallAction:
    """Executes one task of a command. Losing the reservation ends it.

    Args:
        task: The request.
        robot: Executes the request.
    """

    def __init__(self, task: RobotTask, robot: RobotApi) -> None:
        self._task = task
        self._robot = robot

    def run(self) -> dict[str, Any]:
        """Execute the task to its end; returns what limited the motion."""
        self._robot.execute(self._task)
        return {"limited": self._robot.limited} if self._robot.limited else {}

    def kill(self) -> None:
        """Do nothing: the end of the reservation ends the task."""
