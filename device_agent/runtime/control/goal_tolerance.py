"""Goal tolerance: checks that the measured joints, not only the commanded ones, have reached the goal."""

import math
from collections.abc import Collection, Sequence

from device_agent.runtime.errors import Refused

TOLERANCE_RAD = 0.03
"""Position tolerance: many times the error of servos under their own weight [rad]."""
DWELL_S = 0.04
"""Joints must stay within the tolerance for this time, so that passing through is not arrival [s]."""
SETTLE_TIMEOUT_S = 2.0
"""Joints that are outside the tolerance this long after the command has arrived have failed [s]."""


class GoalTolerance:
    """Goal tolerance of one device. Not thread-safe: the controller locks."""

    def __init__(self, names: Sequence[str], period_s: float) -> None:
        self._names = names
        self._dwell_periods = math.ceil(DWELL_S / period_s)
        self._timeout_periods = math.ceil(SETTLE_TIMEOUT_S / period_s)
        self.start(())

    def start(self, moved: Collection[int]) -> None:
        """Start a goal that moves the joints with these indices. Other joints are not checked."""
        self._moved = moved
        self._within_periods = self._waited_periods = 0

    def is_reached(self, target_rad: Sequence[float], measured_rad: Sequence[float], *, soft: Collection[int]) -> bool:
        """Whether the joints have arrived. Call once in each period in which the command rests at the goal.

        Args:
            target_rad: Goal positions, shape (n,).
            measured_rad: Measured positions, shape (n,).
            soft: Joints with reduced stiffness, which are not checked.

        Raises:
            Refused: Joints did not arrive before the timeout.
        """
        errors = {index: abs(target_rad[index] - measured_rad[index]) for index in self._moved if index not in soft}
        outside = [index for index, rad in errors.items() if not rad <= TOLERANCE_RAD]  # NaN is outside
        self._within_periods = 0 if outside else self._within_periods + 1
        self._waited_periods += 1
        if outside and self._waited_periods >= self._timeout_periods:
            short = ", ".join(f"{self._names[index]} is {errors[index]:.2f} rad short" for index in outside)
            raise Refused("not_arrived", f"did not arrive: {short}; check for obstacles and load")
        return self._within_periods >= self._dwell_periods
