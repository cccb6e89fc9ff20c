"""Whether joints have really come to where a move should end: a command that has arrived is not yet an arm that has."""

import math
from collections.abc import Collection, Sequence

from device_agent.runtime.errors import Refused

NEAR_RAD = 0.03
"""As near is there: many times what position servos leave under their own weight, and less than anybody calls short."""
DWELL_S = 0.04
"""So long in a row, so that who only comes through has not arrived."""
SETTLE_TIMEOUT_S = 2.0
"""So long after the command has arrived it may take: any servo that can still come has come."""


class GoalTolerance:
    """One device's. Not thread-safe: its owner locks.

    Args:
        names: Of the joints.
        period_s: The control period [s].
    """

    def __init__(self, names: Sequence[str], period_s: float) -> None:
        self._names = names
        self._dwell = math.ceil(DWELL_S / period_s)
        self._patience = math.ceil(SETTLE_TIMEOUT_S / period_s)
        self.begin(())

    def begin(self, moved: Collection[int]) -> None:
        """A new course, with the indices of the joints that it moves: whoever stays is not asked."""
        self._moved = moved
        self._near = self._waited = 0

    def there(self, target_rad: Sequence[float], measured_rad: Sequence[float], *, soft: Collection[int]) -> bool:
        """Whether they have; to be asked once in each period in which the command rests at its end.

        Args:
            target_rad: Where the joints should be, shape (n,).
            measured_rad: Where they are, shape (n,).
            soft: Joints that hold with less than all their strength, as they were asked to: nobody knows where.

        Raises:
            Refused: They have had time enough.
        """
        off = {index: abs(target_rad[index] - measured_rad[index]) for index in self._moved if index not in soft}
        far = [index for index, rad in off.items() if not rad <= NEAR_RAD]  # what is no number is far
        self._near = 0 if far else self._near + 1
        self._waited += 1
        if far and self._waited >= self._patience:
            short = ", ".join(f"{self._names[index]} is {off[index]:.2f} rad short" for index in far)
            raise Refused("not_arrived", f"did not arrive: {short}; see what holds it, or how it is loaded")
        return self._near >= self._dwell
