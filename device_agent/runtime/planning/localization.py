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
_DRIFT_M, _DRIFT_SHARE = 0.15, 0.1
"""Largest drift of the odometry in one motion: a constant [m], and a share of the distance driven.

Simulated robots drifted by at most 0.12 m, with the delay of the room's positions.
"""


@dataclass(frozen=True, slots=True)
class Pose2D:
    """Pose of a robot in the room [m], [rad]."""

    x_m: float
    y_m: float
    yaw_rad: float


class PoseEstimator:
    """Estimates the pose: odometry has no delay but drifts, room positions are late but do not drift.

    One estimator per device: once the room has reported the robot, its odometry alone is no position any more.
    """

    def __init__(self) -> None:
        self._known_to_room = False
        self._offset: tuple[float, float] | None = None
        self._first_offset: tuple[float, float] | None = None
        self._wheels_m: tuple[float, float] | None = None
        self._driven_m = 0.0
        self._starts = True
        self._max_speed_m_s = 0.0

    def start(self, max_speed_m_s: float) -> None:
        """Start a motion up to this speed [m/s].

        The drift of the odometry counts from the end of the last motion. It counts anew if the robot was driven since
        then, because the length of that path is unknown.
        """
        self._max_speed_m_s = max_speed_m_s
        self._first_offset, self._offset = self._offset or self._first_offset, None
        self._driven_m, self._starts = 0.0, True

    def estimate(self, name: str, odometry: Reading | None, room: Reading | None, *, confirm: bool = False) -> Pose2D:
        """The present pose of the robot with this name in the room's positions.

        Args:
            name: Name of the robot in the room's positions.
            odometry: Position by the robot.
            room: Positions by the room; ``None`` if they do not contain the robot.
            confirm: Whether the room must see the robot now, if it knows the robot.

        Raises:
            Refused: ``no_position``: there is no recent position, or the room has lost the robot.
                ``position_conflict``: the odometry and the room contradict each other.
        """
        wheels = _position(odometry, "")
        observed = _position(room, f".{name}")
        self._known_to_room |= room is not None
        if wheels is None:
            if observed is None or "yaw_rad" not in observed:
                raise Refused("no_position", "the position of the robot is unknown; the robot does not move")
            return Pose2D(observed["x_m"], observed["y_m"], observed["yaw_rad"])
        self._follow_wheels((wheels["x_m"], wheels["y_m"]))
        if observed is not None and room is not None:
            self._correct(wheels, observed, room.age_s + observed.get("age_s", 0.0))
        elif self._known_to_room and (confirm or self._offset is None):
            message = "the room's sensors do not see the robot, so its position is not confirmed"
            raise Refused("no_position", f"{message}; clear their view, or drive the robot to where they see it")
        x, y = self._offset or (0.0, 0.0)
        return Pose2D(wheels["x_m"] + x, wheels["y_m"] + y, wheels["yaw_rad"])

    def _follow_wheels(self, position_m: tuple[float, float]) -> None:
        """Add to the distance driven in this motion, also where the room does not see the robot."""
        moved_m = math.dist(position_m, self._wheels_m or position_m)
        if self._starts and moved_m > _DRIFT_M:
            self._first_offset = None
        self._starts, self._wheels_m = False, position_m
        self._driven_m += moved_m

    def _correct(self, wheels: Mapping[str, float], observed: Mapping[str, float], age_s: float) -> None:
        """Update the offset of the odometry by an observed position of this age [s].

        Raises:
            Refused: ``position_conflict``: it has changed more than odometry drifts.
        """
        offset = observed["x_m"] - wheels["x_m"], observed["y_m"] - wheels["y_m"]
        self._first_offset = self._first_offset or offset
        drift_m = math.dist(offset, self._first_offset)
        if drift_m > _DRIFT_M + _DRIFT_SHARE * self._driven_m + self._max_speed_m_s * age_s:
            self._first_offset = self._offset = None  # the operator has checked the robot before the next motion
            raise Refused(
                "position_conflict",
                f"the robot's odometry and the room's sensors differ by {drift_m:.2f} m; the robot holds. "
                "Check whether it is blocked, slips or is confused with another object",
            )
        (x, y), before = offset, self._offset or offset
        self._offset = before[0] + _ROOM_WEIGHT * (x - before[0]), before[1] + _ROOM_WEIGHT * (y - before[1])


def _position(reading: Reading | None, suffix: str) -> Mapping[str, float] | None:
    """Pose by quantity, if it is complete, finite and recent."""
    if reading is None:
        return None
    names = ("x_m", "y_m", "yaw_rad", "age_s")
    values = {name: float(reading.values[name + suffix]) for name in names if name + suffix in reading.values}
    recent = reading.age_s + values.get("age_s", 0.0) <= STALE_S  # false for NaN
    complete = {"x_m", "y_m"} <= set(values) and all(map(math.isfinite, values.values()))
    return values if recent and complete else None
