"""Port: shape of a robot. The implementer's manual.

Geometry comes from the robot type's model, not from the driver, so simulated and real robots have the same checks. A
robot type without a model has no geometry; only its manifest limits it, and ``desc`` lists the missing limits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol import Pose


class GeometryError(Exception):
    """The model cannot be used, or there is no solution. The message is shown to operators."""


class PlannerLostError(GeometryError):
    """The planner ended or does not respond; the next request starts another."""


def never() -> bool:
    """Default of ``ended``: the plan is still needed."""
    return False


@dataclass(frozen=True, slots=True)
class Clearance:
    """The smallest clearance of a robot.

    Attributes:
        excess_m: Distance minus the required clearance of the closest pair [m]; negative if violated.
        between: The pair: bodies of the robot, fixed objects of its scene, or a frame and a face of the workspace.
        kind: ``clearance`` or ``workspace``.
    """

    excess_m: float
    between: tuple[str, str]
    kind: str = "clearance"

    @property
    def text(self) -> str:
        """Text in ``limited``."""
        return f"{self.kind}: {self.between[0]} \u2013 {self.between[1]}"


@dataclass(frozen=True, slots=True)
class Sweep:
    """Result of checking a path through joint space.

    Attributes:
        share: Collision-free share of the path, 0…1.
        clearance: What blocks it; ``None`` if the whole path is clear.
    """

    share: float
    clearance: Clearance | None = None


class RobotGeometry(Protocol):
    """Shape of one robot in its scene. Thread-safe; joint positions are in the robot type's order [rad]."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames that ``poses`` and ``solve`` accept."""

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        """Pose of each frame in the robot's base frame."""

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        """The smallest clearance in one position, to itself, to obstacles and to the workspace.

        Fast enough for the control loop.
        """

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        """Check straight joint-space segments until a clearance is violated.

        If the start already violates one, the check ends where the distance decreases further, so that the robot can
        leave. Fast enough for the control loop.

        Args:
            path_rad: At least two positions; each segment has the same weight in ``Sweep.share``.
        """

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """Approximate clear share of a straight path, sampled at a few positions.

        It may miss thin obstacles: use it for speed limits, and ``sweep`` for collision checks.
        """

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        """Upper bound of the speed of all points of the robot in any position, by lever arms [m/s]."""

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        """Joint velocities that move a frame, shape (n,) [rad/s]; reduced near singularities.

        Fast enough for the control loop.

        Args:
            frame: One of ``frames``.
            twist: Linear x, y, z [m/s], then angular [rad/s].
            position_rad: Joint positions, shape (n,) [rad].
            tool: Whether the twist is along the frame's own axes instead of the base's.
        """

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        """Joint positions that bring a frame to a pose in the robot's base frame, near ``start_rad`` if possible.

        May take tens of milliseconds: never call it from the control loop.

        Raises:
            GeometryError: The frame is unknown, or the pose is out of reach; the message contains the remaining
                distance.
        """

    def plan(
        self,
        start_rad: Sequence[float],
        goal_rad: Sequence[float],
        *,
        seed: int = 0,
        within_s: float = 5.0,
        ended: Callable[[], bool] = never,
    ) -> tuple[tuple[float, ...], ...]:
        """Positions from ``start_rad`` to ``goal_rad``, connected by collision-free straight segments.

        Keeps more clearance than ``sweep`` requires if possible, so that corners may be blended. Joints of limbs that
        need not move keep their position. May take seconds: never call it from the control loop.

        Args:
            start_rad: Current position.
            goal_rad: Target position.
            seed: Equal seeds give equal plans.
            within_s: Time limit [s].
            ended: Whether the plan is no longer needed; polled continuously.

        Raises:
            GeometryError: No plan was found in time, or the goal violates a clearance.
            PlannerLostError: The planner ended or does not respond.
        """
