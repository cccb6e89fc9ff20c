"""Classes of objects in a room, and how sensors distinguish them."""

import math
from dataclasses import dataclass

from msgspec import Struct


class ObjectClass(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Objects that stand on the floor and may move.

    Attributes:
        name: Name in the positions; further objects of the class are ``person_2``, ``person_3`` …
        lowest_m: Smallest height, sitting or crouching [m]; ``highest_m``: largest height. Ranges may overlap; then the
            last or start position decides.
        radius_m: From the centre to the visible surface [m].
        fastest_m_s: Maximum speed [m/s], reached within about a second.
        several: Whether there may be more than one.
        start_m: Initial x, y [m]; ``None`` if unknown.
    """

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    fastest_m_s: float = 1.5
    several: bool = False
    start_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.lowest_m < self.highest_m or self.radius_m < 0 or self.fastest_m_s <= 0:
            raise ValueError(f"'{self.name}': heights must increase from 0, radius and speed must be above 0")

    def misfit(self, height_m: float) -> float:
        """Deviation of a height from the middle of the range, relative to half the range; up to 1 it fits."""
        middle, half = (self.lowest_m + self.highest_m) / 2, (self.highest_m - self.lowest_m) / 2
        return abs(height_m - middle) / half

    def beyond_m(self, height_m: float) -> float:
        """Distance of a height from the range [m]; negative inside."""
        return max(self.lowest_m - height_m, height_m - self.highest_m)


class Mount(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot with a fixed base.

    Attributes:
        name: Name in the positions.
        lowest_m: Height of the base's lower end [m]; ``highest_m``: of its upper end.
        radius_m: From the base's centre to the visible surface [m].
        near_m: Nominal x, y [m]: identifies the robot; its position is measured.
        reach_m: Largest distance of the robot's points from the nominal position [m].
    """

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    near_m: tuple[float, float]
    reach_m: float

    def __post_init__(self) -> None:
        if not 0 <= self.lowest_m < self.highest_m or self.radius_m < 0 or self.reach_m <= 0:
            raise ValueError(f"'{self.name}': heights must increase from 0, radius and reach must be above 0")


@dataclass(frozen=True, slots=True)
class ObjectPosition:
    """Position of an object.

    Attributes:
        x_m: In the room [m]; ``y_m``: the same.
        age_s: Time since the last detection [s].
        yaw_rad: Direction of its last motion; ``None`` before the first one. Opposite to the heading in reverse.
        speed_m_s: Horizontal speed [m/s].
    """

    x_m: float
    y_m: float
    age_s: float
    yaw_rad: float | None = None
    speed_m_s: float = 0.0

    @property
    def finite(self) -> bool:
        """Whether all values are finite."""
        return all(map(math.isfinite, (self.x_m, self.y_m, self.age_s, self.yaw_rad or 0.0, self.speed_m_s)))
