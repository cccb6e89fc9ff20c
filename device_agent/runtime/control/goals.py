"""What an action asks of the motors: one course at a time, with one end."""

import threading
from dataclasses import dataclass, field
from enum import Enum

from device_agent.ports.driver import Twist
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Trajectory


class GoalResult(Enum):
    """How a course ended."""

    REACHED = "reached"
    INTERRUPTED = "interrupted"


@dataclass(eq=False, kw_only=True)
class MotionGoal:
    """On its way until ``finished`` is set, once, after ``outcome`` and ``why`` are.

    Attributes:
        limited: What made it slower or other than asked, each thing once, as telemetry names it.
    """

    finished: threading.Event = field(default_factory=threading.Event)
    outcome: GoalResult | None = None
    why: Refused | None = None
    limited: tuple[str, ...] = ()

    def note(self, limited: tuple[str, ...]) -> None:
        """Remember what limits it now."""
        self.limited += tuple(one for one in limited if one not in self.limited)

    def end(self, outcome: GoalResult, why: Refused | None = None) -> None:
        """Wake whoever waits."""
        self.outcome, self.why = outcome, why
        self.finished.set()


@dataclass(eq=False, kw_only=True)
class JointGoal(MotionGoal):
    """Joints to positions, shape (n,) [rad], at a share of their speed; then at rest."""

    target_rad: list[float]
    speed: float


@dataclass(eq=False, kw_only=True)
class TrajectoryGoal(MotionGoal):
    """Along a way that was planned; then at rest at its end."""

    way: Trajectory


@dataclass(eq=False, kw_only=True)
class DriveGoal(MotionGoal):
    """The base at a twist, for some control periods; then at rest."""

    twist: Twist
    periods: int
