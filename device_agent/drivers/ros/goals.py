"""Goals of one FollowJointTrajectory action: sending, cancelling and results.

Source of the numbers: ``actionlib_msgs/GoalStatus`` (ROS 1), ``action_msgs/GoalStatus`` (ROS 2) and
``control_msgs/FollowJointTrajectory``.
"""

import itertools
import secrets
import threading
from collections.abc import Mapping, Sequence
from enum import Enum

import msgspec

from device_agent.middleware.ros.connection import (
    ActionCancel,
    ActionGoal,
    ActionResult,
    Command,
    Publication,
    Subscription,
)
from device_agent.middleware.ros.messages import (
    Dialect,
    GoalStatuses,
    Message,
    TrajectoryActionResult,
    TrajectoryResult,
)

OVERDUE_S = 2.0
"""Time for the result after the end of the trajectory [s]."""
SHOWN_S = 2.0
"""How long a failed goal is a fault [s]. The agent latches Stop meanwhile."""
_TOLERANCES = (-4, -5)
"""Error codes of a path tolerance and of a goal tolerance."""
_GOAL = "control_msgs/FollowJointTrajectoryActionGoal"


class Outcome(Enum):
    """How a goal has ended."""

    SUCCEEDED = "has completed the motion"
    CANCELLED = "has ended the motion, because another program sent a goal or a cancellation"
    ABORTED = "has aborted the motion"
    REJECTED = "has rejected the motion"


_ROS1 = {3: Outcome.SUCCEEDED, 2: Outcome.CANCELLED, 8: Outcome.CANCELLED, 5: Outcome.REJECTED}
_ROS2 = {4: Outcome.SUCCEEDED, 5: Outcome.CANCELLED}


class Goals:
    """The goals of one action. A new goal replaces the previous one, which then ends in any way.

    Results arrive in one thread; the other methods may be called by any.

    Args:
        action: Name of the action.
        dialect: Version of ROS.

    Attributes:
        present: Whether the action server has published something. In ROS 2 rosbridge reports a missing server.
    """

    def __init__(self, action: str, dialect: Dialect) -> None:
        self.action = action.rstrip("/")
        self._dialect = dialect
        self._session = f"telescope-{secrets.token_hex(4)}"
        self._numbers = itertools.count(1)
        self._newest = ""
        self._due_s: float | None = None
        self._problem: tuple[str, float] | None = None
        self._lock = threading.Lock()
        self.present = dialect.ros != 1

    # ------------------------------------------------------------ topics

    @property
    def advertised(self) -> Mapping[str, str]:
        """Topics to publish, with their types."""
        if self._dialect.ros != 1:
            return {}
        return {f"{self.action}/goal": _GOAL, f"{self.action}/cancel": "actionlib_msgs/GoalID"}

    @property
    def subscriptions(self) -> Sequence[Subscription]:
        """Topics to receive."""
        if self._dialect.ros != 1:
            return ()
        result, status = "control_msgs/FollowJointTrajectoryActionResult", "actionlib_msgs/GoalStatusArray"
        return (
            Subscription(f"{self.action}/result", result, TrajectoryActionResult, self.accept_ros1),
            Subscription(f"{self.action}/status", status, GoalStatuses, self.accept_status),
        )

    # ------------------------------------------------------------ goals

    def start(self, trajectory: Message, *, due_s: float | None) -> Command:
        """A new goal, which replaces the previous one.

        Args:
            trajectory: The JointTrajectory.
            due_s: When its result is overdue [s]; ``None``: the result is not awaited.
        """
        number = f"{self._session}-{next(self._numbers)}"
        with self._lock:
            self._newest, self._due_s = number, due_s
        goal = self._dialect.goal(trajectory)
        if self._dialect.ros != 1:
            return ActionGoal(self.action, "control_msgs/action/FollowJointTrajectory", number, goal)
        goal_id = {"stamp": self._dialect.time(0.0), "id": number}
        return Publication(f"{self.action}/goal", {"goal_id": goal_id, "goal": goal})

    def cancel(self) -> Command | None:
        """The cancellation of the newest goal; ``None`` if there is none whose result is awaited."""
        with self._lock:
            number, awaited, self._due_s = self._newest, self._due_s is not None, None
            self._newest = ""
        if not awaited:
            return None
        if self._dialect.ros != 1:
            return ActionCancel(self.action, number)
        return Publication(f"{self.action}/cancel", {"stamp": self._dialect.time(0.0), "id": number})

    def cancel_overdue(self, now_s: float) -> Command | None:
        """The cancellation of a goal whose result is overdue, which becomes a fault."""
        with self._lock:
            overdue = self._due_s is not None and now_s > self._due_s
            if overdue:
                self._problem = (f"{self.action} has reported no result; check the controller", now_s)
        return self.cancel() if overdue else None

    @property
    def pending(self) -> bool:
        """Whether the result of the newest goal is awaited."""
        return self._due_s is not None

    def problem(self, now_s: float) -> str:
        """Why the newest goal has failed, for ``SHOWN_S`` after it; empty if there is no failure."""
        problem = self._problem
        return problem[0] if problem is not None and now_s - problem[1] < SHOWN_S else ""

    # ------------------------------------------------------------ received

    def accept_status(self, message: GoalStatuses, at_s: float) -> None:
        """Use a status of the action server of ROS 1."""
        del message, at_s
        self.present = True

    def accept_ros1(self, message: TrajectoryActionResult, at_s: float) -> None:
        """Use a result of ROS 1."""
        status, result = message.status, message.result
        text = result.error_string or status.text
        self._end(status.goal_id.id, _ROS1.get(status.status, Outcome.ABORTED), result.error_code, text, at_s)

    def accept_ros2(self, message: ActionResult, at_s: float) -> None:
        """Use a result of ROS 2.

        Raises:
            ValueError: It is invalid.
        """
        if not message.result:
            self._end(message.id, Outcome.REJECTED, 0, str(message.values), at_s)
            return
        result = msgspec.convert(message.values, TrajectoryResult)
        outcome = _ROS2.get(message.status, Outcome.ABORTED)
        self._end(message.id, outcome, result.error_code, result.error_string, at_s)

    def _end(self, number: str, outcome: Outcome, code: int, text: str, at_s: float) -> None:
        if not number.startswith(self._session):
            return  # a goal of another program
        if outcome is Outcome.SUCCEEDED and code != 0:
            outcome = Outcome.ABORTED
        with self._lock:
            newest = number == self._newest
            if newest:
                self._due_s = None
            # A goal that was replaced may end in any way, except for a tolerance: then the arm met an obstacle.
            failed = outcome is not Outcome.SUCCEEDED if newest else outcome is Outcome.REJECTED or code in _TOLERANCES
            if failed:
                reason = f": {text[:200]}" if text else ""
                self._problem = (f"{self.action} {outcome.value} (error code {code}){reason}", at_s)
