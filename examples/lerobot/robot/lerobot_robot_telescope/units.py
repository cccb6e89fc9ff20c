"""Conversion between radians and LeRobot's units, as LeRobot's own arms use them."""

import math
from collections.abc import Mapping
from typing import Any

SUFFIX = ".pos"


class Units:
    """Units of the joints of one device.

    Args:
        joints: The joints with their limits, as the API describes them.
        gripper: Joint in percent of its range; the others are in degrees.
    """

    def __init__(self, joints: list[dict[str, Any]], gripper: str) -> None:
        self.names = [joint["name"] for joint in joints]
        self._limits_rad = {joint["name"]: (joint["lower_rad"], joint["upper_rad"]) for joint in joints}
        self._gripper = gripper

    @property
    def features(self) -> dict[str, type]:
        """Names and types of LeRobot's values."""
        return {name + SUFFIX: float for name in self.names}

    def to_lerobot(self, position_rad: list[float]) -> dict[str, float]:
        """Positions of all joints in LeRobot's units."""
        return {
            name + SUFFIX: self._to_value(name, value) for name, value in zip(self.names, position_rad, strict=True)
        }

    def to_rad(self, action: Mapping[str, float]) -> dict[str, float]:
        """Positions of the named joints [rad].

        Raises:
            ValueError: A name is not a joint, or a value is not finite.
        """
        unknown = sorted(set(action) - set(self.features))
        if unknown:
            raise ValueError(f"no joint {', '.join(unknown)}; there are: {', '.join(self.features)}")
        if not all(math.isfinite(value) for value in action.values()):
            raise ValueError("a position is not finite")
        return {key.removesuffix(SUFFIX): self._to_rad(key.removesuffix(SUFFIX), action[key]) for key in action}

    def _to_value(self, name: str, position_rad: float) -> float:
        lower, upper = self._limits_rad[name]
        return (position_rad - lower) / (upper - lower) * 100 if name == self._gripper else math.degrees(position_rad)

    def _to_rad(self, name: str, value: float) -> float:
        lower, upper = self._limits_rad[name]
        return lower + float(value) / 100 * (upper - lower) if name == self._gripper else math.radians(value)
