"""Navigation of a mobile robot to a place in the room: the next twist along a path over the free floor."""

import math

from device_agent.ports.driver import REST, Twist
from device_agent.ports.floor_map import ObstacleMap
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.grid_search import find_path
from device_agent.runtime.planning.localization import Pose2D

UPDATE_PERIOD_S = 0.1
"""Period of pose and twist updates; a twist that is not renewed ends soon after [s]."""
BLOCKED_TIMEOUT_S = 15.0
"""Time to wait for a person who blocks the path [s]."""
START_TIMEOUT_S = 6.0
"""The same before the robot has started: an occupied goal is then more likely furniture than a person [s]."""
_TRANSIENT = frozenset({"no_way", "taken"})
"""Rejections that may end soon."""
_AHEAD_M = 0.2
_REPLAN_UPDATES = 4
"""Updates between two path searches."""
MAX_APPROACHES = 3
SETTLE_UPDATES = 10
"""Updates at rest before the arrival is checked."""
_NEAR_M, _NEAR_RAD = 0.03, 0.04
_LEFT_M = 0.05
"""A robot that drifts this far from the goal while it turns approaches again [m]."""
_TOLERANCE_M, _TOLERANCE_RAD = 0.08, 0.1
"""Largest error at rest; the position by the room's sensors has an error of about 2 cm [m], [rad]."""
_SPEED_SHARE = 0.8
_GAIN_1_S = 1.2
"""Proportional gain of distance and heading [1/s]."""
_FACING_RAD = 0.5
"""The robot turns on the spot while the heading error is larger [rad]."""


class Navigator:
    """Navigation to one goal."""

    def __init__(self, goal: tuple[float, float], yaw_rad: float | None, *, limits: Twist, radius_m: float) -> None:
        self._goal = goal
        self._yaw_rad = yaw_rad
        self._limits = limits
        self._radius_m = radius_m
        self._arrived = False
        self._updates = 0
        self._started = False
        self._path: list[tuple[float, float]] = []

    @classmethod
    def for_robot(cls, x_m: float, y_m: float, yaw_rad: float | None, robot_type: RobotType) -> "Navigator":
        """Navigator of a robot of this type.

        Raises:
            Refused: The robot has no base, or a value is not finite.
        """
        base = robot_type.base
        if base is None:
            raise Refused("no_base", "this robot does not drive")
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad or 0.0))):
            raise Refused("not_finite", "a place must consist of finite numbers")
        limits = Twist(base.max_linear_m_s, 0.0, base.max_angular_rad_s)
        return cls((x_m, y_m), yaw_rad, limits=limits, radius_m=base.radius_m)

    @property
    def max_speed_m_s(self) -> float:
        """Largest speed towards the goal [m/s]."""
        return _SPEED_SHARE * self._limits.forward_m_s

    def timeout_s(self, refused: Refused) -> float:
        """Time to wait until a rejected motion may become possible [s]."""
        if refused.code not in _TRANSIENT:
            return 0.0
        return START_TIMEOUT_S if refused.code == "taken" and not self._started else BLOCKED_TIMEOUT_S

    def replan(self) -> None:
        """Search the path anew in the next update: the robot has rested, and the room may have changed."""
        self._path = []

    def compute_twist(self, pose: Pose2D, obstacle_map: ObstacleMap) -> Twist | None:
        """The next twist; ``None`` at the goal.

        Raises:
            Refused: There is no path now.
        """
        position = (pose.x_m, pose.y_m)
        distance_m = math.dist(self._goal, position)
        # A small overshoot does not restart the approach.
        self._arrived = (self._arrived and distance_m < _LEFT_M) or distance_m <= _NEAR_M
        if self._arrived:
            if self._yaw_rad is None:
                return None
            error = math.remainder(self._yaw_rad - pose.yaw_rad, 2 * math.pi)
            return None if abs(error) <= _NEAR_RAD else REST._replace(turn_rad_s=self._turn(error))
        if self._updates % _REPLAN_UPDATES == 0 or not self._path:
            self._path = []  # after a failed search, the next update searches again
            blocked = obstacle_map.blocked(self._radius_m, apart=[(*position, self._radius_m)])
            self._path = find_path(blocked, position, self._goal)
            self._started = True
        self._updates += 1
        passed = min(range(len(self._path)), key=lambda index: math.dist(self._path[index], position))
        x, y = next((point for point in self._path[passed:] if math.dist(point, position) >= _AHEAD_M), self._goal)
        error = math.remainder(math.atan2(y - pose.y_m, x - pose.x_m) - pose.yaw_rad, 2 * math.pi)
        forward = 0.0
        if abs(error) < _FACING_RAD:
            forward = min(self.max_speed_m_s, _GAIN_1_S * distance_m) * math.cos(error)
        return Twist(forward, 0.0, self._turn(error))

    def is_near(self, pose: Pose2D) -> bool:
        """Whether another approach would not bring the robot nearer to the goal."""
        away_m, away_rad = self._errors(pose)
        self._arrived = away_m <= _LEFT_M
        return self._arrived and away_rad <= 2 * _NEAR_RAD

    def require_arrival(self, pose: Pose2D) -> None:
        """Check the pose at rest.

        Raises:
            Refused: ``not_arrived``: the robot is not at the goal.
        """
        away_m, away_rad = self._errors(pose)
        if away_m > _TOLERANCE_M or away_rad > _TOLERANCE_RAD:
            raise Refused(
                "not_arrived",
                f"did not arrive: the robot is {away_m:.2f} m and {away_rad:.2f} rad from the goal; "
                "check for obstacles and slip",
            )

    def _errors(self, pose: Pose2D) -> tuple[float, float]:
        """Distance from the goal [m] and from its heading [rad]."""
        away_rad = 0.0 if self._yaw_rad is None else math.remainder(self._yaw_rad - pose.yaw_rad, 2 * math.pi)
        return math.dist(self._goal, (pose.x_m, pose.y_m)), abs(away_rad)

    def _turn(self, error_rad: float) -> float:
        limit = _SPEED_SHARE * self._limits.turn_rad_s
        return min(max(_GAIN_1_S * error_rad, -limit), limit)
