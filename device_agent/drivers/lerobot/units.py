"""Conversion between LeRobot's units and radians."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from device_agent.drivers.lerobot.robots import TICKS

_MAX_RAD = 3 * math.pi
"""An encoder that is calibrated to one turn measures less [rad]."""


@dataclass(frozen=True, slots=True)
class JointUnit:
    """Units of one joint.

    LeRobot measures a joint in degrees from the center of its calibrated range, and a gripper in percent of the range.
    Telescope measures the gripper as an angle from its closed position.

    Attributes:
        range_ticks: Size of the calibrated range on the encoder.
        closed_rad: Position of a closed gripper [rad]; ``None``: not a gripper.
    """

    range_ticks: int
    closed_rad: float | None = None

    @property
    def size_rad(self) -> float:
        """Size of the calibrated range [rad]."""
        return self.range_ticks * math.tau / TICKS

    @property
    def lower_rad(self) -> float:
        """Lower end of the calibrated range [rad]."""
        return -self.size_rad / 2 if self.closed_rad is None else self.closed_rad

    @property
    def upper_rad(self) -> float:
        """Upper end of the calibrated range [rad]."""
        return self.lower_rad + self.size_rad

    def to_rad(self, value: float) -> float:
        """Position of a value of LeRobot [rad]."""
        return math.radians(value) if self.closed_rad is None else self.closed_rad + value / 100 * self.size_rad

    def from_rad(self, position_rad: float) -> float:
        """LeRobot's value of a position within the range."""
        if self.closed_rad is None:
            return math.degrees(position_rad)
        return (position_rad - self.closed_rad) / self.size_rad * 100

    def limit(self, position_rad: float) -> float:
        """The nearest position in the calibrated range [rad]."""
        return min(max(position_rad, self.lower_rad), self.upper_rad)


def positions_rad(units: Sequence[JointUnit], values: Sequence[float]) -> tuple[float, ...] | None:
    """Positions of all joints [rad], or ``None`` if one is not a position that an encoder can measure."""
    if len(values) != len(units):
        return None
    positions = tuple(unit.to_rad(value) for unit, value in zip(units, values, strict=True))
    return positions if all(abs(position) < _MAX_RAD for position in positions) else None
