"""Localization of a mobile robot: fuses its odometry with the positions that room sensors publish."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from device_agent.runtime.errors import Refused
from device_agent.runtime.readings import Reading

STALE_S = 1.0
"""Maximum age of a position [s]."""
ODOMETRY, POSITIONS = "odometry", "positions"
"""Streams with positions: that of the robot, and that of a room device."""
_ROOM_WEIGHT = 0.1
"""Weight of each new position from the room against the odometry."""


@dataclass(frozen=True, slots=True)
class Pose2D:
    """Pose of a robot in the room [m], [rad]."""

    x_m: float
    y_m: float
    yaw_rad: float


class PoseEstimator:
    """Estimates the pose: odometry has no delay but drifts, room positions are late but do not drift."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._offset: tuple[float, float] | None = None

    def estimate(self, odometry: Reading | None, room: Reading | None) -> Pose2D:
        """The present pose.

        Raises:
            Refused: There is no recent position.
        """
        wheels = _position(odometry, "")
        observed = _position(room, f".{self._name}")
        if wheels is None:
            if observed is None or "yaw_rad" not in observed:
                raise Refused("no_position", "the position of the robot is unknown; the robot does not move")
            return Pose2D(observed["x_m"], observed["y_m"], observed["yaw_rad"])
        if observed is not None:
            x, y = observed["x_m"] - wheels["x_m"], observed["y_m"] - wheels["y_m"]
            before = self._offset or (x, y)
            self._offset = before[0] + _ROOM_WEIGHT * (x - before[0]), before[1] + _ROOM_WEIGHT * (y - before[1])
        x, y = self._offset or (0.0, 0.0)
        return Pose2D(wheels["x_m"] + x, wheels["y_m"] + y, wheels["yaw_rad"])


def _position(reading: Reading | None, suffix: str) -> Mapping[str, float] | None:
    """Pose by quantity, if it is complete, finite and recent."""
    if reading is None:
        return None
    names = ("x_m", "y_m", "yaw_rad", "age_s")
    values = {name: float(reading.values[name + suffix]) for name in names if name + suffix in reading.values}
    recent = reading.age_s + values.get("age_s", 0.0) <= STALE_S  # false for NaN
    complete = {"x_m", "y_m"} <= set(values) and all(map(math.isfinite, values.values()))
    return values if recent and complete else None
