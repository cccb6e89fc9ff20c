"""The pose of a robot base in a room."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class BasePose:
    """A room's model and the pose of the robot's origin in it.

    Attributes:
        room: MJCF file of the room without robots. Moving objects in it are excluded from all checks.
        position_m: Robot origin in the room [m].
        yaw_rad: Rotation about the vertical [rad].
    """

    room: Path
    position_m: tuple[float, float, float]
    yaw_rad: float
