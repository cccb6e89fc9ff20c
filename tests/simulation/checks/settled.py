"""Checks after all faults have ended and the system had time to settle."""

from function_app.domain.actions.action import Status
from function_app.domain.actions.queue import UNPAIRED
from tests.simulation.checks.history import History
from tests.simulation.checks.robots import RobotChecks
from tests.simulation.checks.rows import RowChecks


def check(history: History, rows: RowChecks, robots: RobotChecks) -> None:
    """Every action has one terminal state, and it is the one of the robot."""
    at_robot = {action: status for model in robots.models.values() for action, status in model.ended.items()}
    ending = {action: status for model in robots.models.values() for action, status in model.ending.items()}
    for action, fact in rows.actions.items():
        shown = f"action {action[-6:]}: {fact.status.value} {fact.code}".rstrip()
        ended = at_robot.get(action)
        if not fact.status.terminal:
            history.violate("not-terminal", f"{shown} in the cloud, {ended} at the robot")
        elif fact.exempt or fact.code == UNPAIRED:  # the cloud does not wait for an unpaired robot
            continue
        elif ended == "done" and fact.status is not Status.DONE:
            history.violate(f"completed-not-done ({fact.code})", f"{shown} in the cloud, completed at the robot")
        elif fact.status is Status.DONE and ended is None and ending.get(action) == "done":
            continue  # the process was killed after it had stored the end, and before it had returned
        elif fact.status is Status.DONE and ended != "done":
            history.violate("done-not-completed", f"{shown} in the cloud, {ended} at the robot")
        elif ended is not None and ended != fact.status.value:
            history.violate(f"other-status ({fact.code})", f"{shown} in the cloud, {ended} at the robot")
