"""Where a robot stands in a room."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class BasePose:
    """A room's model, and the place of the robot's origin in it.

    Attributes:
        room: MJCF file of the room without robots. What moves in it is left out of all checks.
        position_m: Of the robot's origin in the room [m].
        yaw_rad: About the vertical [rad].
    """

    room: Path
    position_m: tuple[float, float, float]
    yaw_rad: float
