"""Motion planning: collision-free and straight-line trajectories. Never called in the control loop."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from device_agent.ports.geometry import GeometryError, PlannerLostError, RobotGeometry
from device_agent.protocol import Pose, Quaternion, Vector3
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import trajectory
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats, Trajectory

_SEARCH_TIMEOUT_S = 5.0
_ATTEMPTS = 3
_STEP_M, _STEP_RAD = 0.01, 0.05
"""Distance between poses on a straight path for which inverse kinematics is solved."""
_MAX_CHANGE_RAD = 0.3
"""A joint that turns further between two poses changes its configuration: the path is not straight [rad]."""
_SPACING_RAD = 0.03
"""Spacing of the points of a straight path; between them it deviates by less than a tenth of a millimetre [rad]."""
_MIN_NORM = 1e-6


class MotionPlanner:
    """Motion planner of one robot."""

    def __init__(self, robot_type: RobotType, geometry: RobotGeometry, *, seed: int = 0) -> None:
        self._seed = seed
        self._type = robot_type
        self._geometry = geometry
        self._couplings = Couplings(robot_type)

    def plan(
        self, start_rad: Sequence[float], goal_rad: Sequence[float], *, speed: float, ended: Callable[[], bool]
    ) -> Trajectory:
        """A collision-free trajectory with blended corners; ``ended`` is polled, and ends the search.

        Raises:
            Refused: No path was found, or the search was ended.
        """
        for seed in range(_ATTEMPTS):
            try:
                corners = self._geometry.plan(
                    start_rad, goal_rad, seed=self._seed + seed, within_s=_SEARCH_TIMEOUT_S, ended=ended
                )
            except PlannerLostError as error:
                raise Refused("planner_lost", str(error)) from error
            except GeometryError as error:
                raise Refused("no_way", str(error)) from error
            points = trajectory.blend_corners(corners, self._is_clear)
            if points is not None:
                return self._parameterize(points, speed)
        raise Refused("no_way", "the paths that were found are too narrow; move to a place with more room first")

    def plan_straight(self, start_rad: Sequence[float], frame: str, pose: Pose, *, speed: float) -> Trajectory:
        """A trajectory on which a frame moves straight to a pose in the base frame, and turns at a constant rate.

        Raises:
            Refused: Out of reach, not straight, or an obstacle is in the way.
        """
        start = self._geometry.poses(start_rad)[frame]
        turn = _rotation_between(start[3:], pose[3:])
        steps = max(
            2,
            math.ceil(math.dist(start[:3], pose[:3]) / _STEP_M),
            math.ceil(2 * math.acos(min(1.0, abs(turn[0]))) / _STEP_RAD),
        )
        points = [np.array(start_rad)]
        for step in range(1, steps + 1):
            share = step / steps
            x, y, z = (a + share * (b - a) for a, b in zip(start[:3], pose[:3], strict=True))
            try:
                turned = _times(start[3:], _scale(turn, share))
                solution = self._geometry.solve(frame, (x, y, z, *turned), points[-1].tolist())
            except GeometryError as error:
                raise Refused("out_of_reach", f"{share:.0%} of the way there: {error}") from error
            points.append(np.array(solution))
            if float(np.max(np.abs(points[-1] - points[-2]))) > _MAX_CHANGE_RAD:
                raise Refused(
                    "not_straight",
                    f"{frame} cannot go straight there: at {share:.0%} of the way the robot would have to change its "
                    "configuration; use straight=False or plan=True",
                )
        swept = self._geometry.sweep([point.tolist() for point in points])
        if swept.clearance is not None:
            raise Refused("no_room", f"an obstacle is in the way: {swept.clearance.text}; use plan=True")
        return self._parameterize(trajectory.resample(np.array(points), _SPACING_RAD), speed)

    def _parameterize(self, points: Floats, speed: float) -> Trajectory:
        return trajectory.time_parameterize(points, self._type.joints, speed=speed, step_s=self._type.period_ms / 1000)

    def _is_clear(self, path_rad: Floats) -> bool:
        return (
            not self._couplings.describe_violation(path_rad)
            and self._geometry.sweep(path_rad.tolist()).clearance is None
        )


def quaternion_of(
    poses: Mapping[str, Pose], frame: str, quaternion: Quaternion | None, rpy_rad: Vector3 | None
) -> Quaternion:
    """The requested orientation as a unit quaternion; without a request, that of the frame.

    Raises:
        Refused: Unknown frame, two orientations, or a quaternion of length 0.
    """
    if frame not in poses:
        raise Refused("unknown_frame", f"no frame '{frame[:80]}'; there are {', '.join(poses)}")
    if quaternion is not None and rpy_rad is not None:
        raise Refused("bad_quaternion", "give a quaternion or rpy_rad, not both")
    if rpy_rad is not None:
        return _from_rpy(rpy_rad)
    w, x, y, z = poses[frame][3:] if quaternion is None else quaternion
    length = math.hypot(w, x, y, z)
    if not _MIN_NORM < length < math.inf:
        raise Refused("bad_quaternion", "the quaternion (w, x, y, z) has no direction")
    return (w / length, x / length, y / length, z / length)


def _from_rpy(rpy_rad: Vector3) -> Quaternion:
    """Roll, pitch, yaw about the fixed x, y, z [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle / 2), math.sin(angle / 2)) for angle in rpy_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _rotation_between(start: Quaternion, end: Quaternion) -> Quaternion:
    """The shorter rotation from one orientation to another, in the axes of the first."""
    w, x, y, z = start
    turn = _times((w, -x, -y, -z), end)
    sign = math.copysign(1.0, turn[0])
    return (sign * turn[0], sign * turn[1], sign * turn[2], sign * turn[3])


def _scale(turn: Quaternion, share: float) -> Quaternion:
    """A share of a rotation."""
    w, *axis = turn
    size = math.hypot(*axis)
    if size < _MIN_NORM:
        return (1.0, 0.0, 0.0, 0.0)
    half = math.atan2(size, w) * share
    x, y, z = (math.sin(half) * part / size for part in axis)
    return (math.cos(half), x, y, z)


def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )
