"""What is known of a robot's shape, whoever moves it. This page is the implementer's manual.

It comes from the robot type's model, not from the driver: the same checks hold for a simulation and for real metal. A
robot type without a model has no geometry; then only what stands in its manifest limits it, and ``desc`` says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from device_agent.protocol import Pose


class GeometryError(Exception):
    """The model cannot be used, or has no answer. Its text is fit for an operator."""


class PlannerLostError(GeometryError):
    """Whoever looks for ways has ended, or does not answer; asked again, another one does."""


def never() -> bool:
    """It is always wanted."""
    return False


@dataclass(frozen=True, slots=True)
class Clearance:
    """The tightest place of a robot.

    Attributes:
        room_m: What is left until the tightest pair is as near as it may be; negative when it is nearer [m].
        between: The two that are near each other: bodies of the robot, or things that stand still in its scene, or a
            frame and a face of the workspace.
        kind: ``clearance`` or ``workspace``.
    """

    room_m: float
    between: tuple[str, str]
    kind: str = "clearance"

    @property
    def text(self) -> str:
        """As ``limited`` names it."""
        return f"{self.kind}: {self.between[0]} \u2013 {self.between[1]}"


@dataclass(frozen=True, slots=True)
class Sweep:
    """How a way through joint space went.

    Attributes:
        share: How much of it is clear, 0…1.
        clearance: What ends it; ``None`` when all of it is clear.
    """

    share: float
    clearance: Clearance | None = None


class RobotGeometry(Protocol):
    """One robot's shape in the scene it stands in. Thread-safe; joint positions are in the robot type's order [rad]."""

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames that ``poses`` and ``solve`` know."""

    def poses(self, position_rad: Sequence[float]) -> Mapping[str, Pose]:
        """Pose of each frame in the robot's base frame."""

    def clearance(self, position_rad: Sequence[float]) -> Clearance:
        """The tightest place of the robot in one position: itself, what stands around it, its workspace.

        Quick enough for the control loop.
        """

    def sweep(self, path_rad: Sequence[Sequence[float]]) -> Sweep:
        """Go from one joint position straight to the next until something is nearer than it may be.

        From where something is too near already: until it comes nearer still, so that it can be left.

        Quick enough for the control loop.

        Args:
            path_rad: At least two positions; each leg counts alike in ``Sweep.share``.
        """

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """The share of a straight way that seems clear, by a few places on it.

        What is thin may be missed: this is for how fast to go there, ``sweep`` for whether.
        """

    def speed_m_s(self, velocity_rad_s: Sequence[float]) -> float:
        """A speed that no point of the robot exceeds, in whatever position, by the lever arms of its joints [m/s]."""

    def rates(
        self, frame: str, twist: Sequence[float], position_rad: Sequence[float], *, tool: bool
    ) -> tuple[float, ...]:
        """Joint velocities that move a frame, shape (n,) [rad/s]; less where they would have to be very high.

        Quick enough for the control loop.

        Args:
            frame: One of ``frames``.
            twist: Linear x, y, z [m/s], then angular [rad/s].
            position_rad: Where the joints are, shape (n,) [rad].
            tool: Whether the twist is along the frame's own axes, not the base's.
        """

    def solve(self, frame: str, pose: Pose, start_rad: Sequence[float]) -> tuple[float, ...]:
        """Joint positions that bring a frame to a pose in the robot's base frame, near ``start_rad`` where possible.

        May take tens of milliseconds: never call it from the control loop.

        Raises:
            GeometryError: No such frame, or out of reach; the text says how near the robot can come.
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
        """Positions from ``start_rad`` to ``goal_rad``, with a straight way between each and the next that is clear.

        With more room than ``sweep`` asks for, where there is that much, so that the way may be rounded off. Joints of
        limbs that need not move stay. May take seconds: never call it from the control loop.

        Args:
            start_rad: Where the device is.
            goal_rad: Where it shall be.
            seed: The same seed finds the same way.
            within_s: How long to look for one [s].
            ended: Whether nobody wants it any more; asked all the time.

        Raises:
            GeometryError: None was found in time, or there is no room at its end; the text says so.
            PlannerLostError: Whoever looks for it has ended or does not answer.
        """
