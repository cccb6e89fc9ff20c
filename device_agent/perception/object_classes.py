"""Whom a room may hold, and how to tell them apart by what sensors see."""

import math
from dataclasses import dataclass

from msgspec import Struct


class ObjectClass(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Somebody who stands on the floor and may move.

    Attributes:
        name: As the positions call it; of several at a time the others are ``person_2``, ``person_3`` …
        lowest_m: How high it is at least, sitting or crouching [m]; ``highest_m``: at most. Kinds may overlap: where
            they do, it tells them apart where each was last, and began.
        radius_m: From its middle to the side that sensors see [m].
        fastest_m_s: How fast it goes [m/s]; it gets there in about a second.
        several: Whether there may be more than one.
        start_m: x, y where it was put at the beginning [m]; ``None`` where nobody knows.
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
            raise ValueError(f"'{self.name}': its heights rise from 0 on, its radius and speed are above 0")

    def misfit(self, height_m: float) -> float:
        """How far a height is from the middle of its own, as a share of half their range: up to 1 it fits."""
        middle, half = (self.lowest_m + self.highest_m) / 2, (self.highest_m - self.lowest_m) / 2
        return abs(height_m - middle) / half

    def beyond_m(self, height_m: float) -> float:
        """How far a height is outside of its own [m]; negative inside."""
        return max(self.lowest_m - height_m, height_m - self.highest_m)


class Mount(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A robot that is fixed to something, and moves above it.

    Attributes:
        name: As the positions call it.
        lowest_m: Of the part that never moves, its base: from here [m]; ``highest_m``: to here.
        radius_m: From the base's middle to the side that sensors see [m].
        near_m: x, y where it was said to stand [m]: tells which of several it is, never where it is.
        reach_m: What belongs to it is not further from there [m].
    """

    name: str
    lowest_m: float
    highest_m: float
    radius_m: float
    near_m: tuple[float, float]
    reach_m: float

    def __post_init__(self) -> None:
        if not 0 <= self.lowest_m < self.highest_m or self.radius_m < 0 or self.reach_m <= 0:
            raise ValueError(f"'{self.name}': its heights rise from 0 on, its radius and reach are above 0")


@dataclass(frozen=True, slots=True)
class Place:
    """Where somebody is.

    Attributes:
        x_m: In the room [m]; ``y_m``: the same.
        age_s: Since a sensor last saw it [s].
        yaw_rad: Where it goes, or last went; ``None`` before its first step. Who drives backwards looks the other way.
        speed_m_s: Over the floor [m/s].
    """

    x_m: float
    y_m: float
    age_s: float
    yaw_rad: float | None = None
    speed_m_s: float = 0.0

    @property
    def finite(self) -> bool:
        """Whether all of it is a number."""
        return all(map(math.isfinite, (self.x_m, self.y_m, self.age_s, self.yaw_rad or 0.0, self.speed_m_s)))
