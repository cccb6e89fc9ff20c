"""Motion goals of an action. A device executes one goal at a time; each goal has one result."""

import threading
from dataclasses import dataclass, field
from enum import Enum

from device_agent.ports.driver import Twist
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Trajectory


class GoalResult(Enum):
    """How a goal ended."""

    REACHED = "reached"
    INTERRUPTED = "interrupted"


@dataclass(eq=False, kw_only=True)
class MotionGoal:
    """Goal in execution until ``finished`` is set. ``result`` and ``why`` are set before.

    Attributes:
        limited: Limits that changed the motion, each once, as telemetry names them.
    """

    finished: threading.Event = field(default_factory=threading.Event)
    result: GoalResult | None = None
    why: Refused | None = None
    limited: tuple[str, ...] = ()

    def add_limits(self, limited: tuple[str, ...]) -> None:
        """Add limits that apply now."""
        self.limited += tuple(limit for limit in limited if limit not in self.limited)

    def end(self, result: GoalResult, why: Refused | None = None) -> None:
        """Set the result and wake waiting threads."""
        self.result, self.why = result, why
        self.finished.set()


@dataclass(eq=False, kw_only=True)
class JointGoal(MotionGoal):
    """Joint positions, shape (n,) [rad], at a share of the speed; ends at rest."""

    target_rad: list[float]
    speed: float


@dataclass(eq=False, kw_only=True)
class TrajectoryGoal(MotionGoal):
    """A planned trajectory; ends at rest."""

    trajectory: Trajectory


@dataclass(eq=False, kw_only=True)
class DriveGoal(MotionGoal):
    """A twist of the base for a number of control periods; ends at rest."""

    twist: Twist
    periods: int
