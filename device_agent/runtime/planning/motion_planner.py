"""Finds ways to go along before anything moves: around things, or straight through space. Never in the control loop."""

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

_SEARCH_S = 5.0
_SEEDS = 3
_STEP_M, _STEP_RAD = 0.01, 0.05
"""Between places of a straight way, for which joint positions are found one after the other."""
_LEAP_RAD = 0.3
"""A joint that turns by more between two of them goes to another posture: no straight way."""
_APART_RAD = 0.03
"""Of the points through which a straight way is drawn: between them it strays by less than a tenth of a millimetre."""
_SHORTEST = 1e-6


class MotionPlanner:
    """Ways of one robot.

    Args:
        robot_type: Joints and limits.
        geometry: The robot's shape.
        seed: Of the search for a way: the same finds the same.
    """

    def __init__(self, robot_type: RobotType, geometry: RobotGeometry, *, seed: int = 0) -> None:
        self._seed = seed
        self._type = robot_type
        self._geometry = geometry
        self._couplings = Couplings(robot_type)

    def around(
        self, start_rad: Sequence[float], goal_rad: Sequence[float], *, speed: float, ended: Callable[[], bool]
    ) -> Trajectory:
        """A way around what is near, rounded off where there is room for it.

        Args:
            start_rad: Where the joints are, shape (n,) [rad].
            goal_rad: Where they shall be, shape (n,) [rad].
            speed: Share of each joint's velocity limit.
            ended: Whether nobody wants it any more.

        Raises:
            Refused: None was found, or whoever looks for it has ended.
        """
        for seed in range(_SEEDS):
            try:
                corners = self._geometry.plan(
                    start_rad, goal_rad, seed=self._seed + seed, within_s=_SEARCH_S, ended=ended
                )
            except PlannerLostError as error:
                raise Refused("planner_lost", str(error)) from error
            except GeometryError as error:
                raise Refused("no_way", str(error)) from error
            points = trajectory.blend_corners(corners, self._clear)
            if points is not None:
                return self._timed(points, speed)
        raise Refused("no_way", "what was found is too narrow to go along; move to a place with more room first")

    def straight(self, start_rad: Sequence[float], frame: str, pose: Pose, *, speed: float) -> Trajectory:
        """A way on which a frame goes straight to a pose, and turns evenly.

        Args:
            start_rad: Where the joints are, shape (n,) [rad].
            frame: One of the geometry's frames.
            pose: In the robot's base frame.
            speed: Share of each joint's velocity limit.

        Raises:
            Refused: It cannot go there, not straight, or something is in the way.
        """
        begin = self._geometry.poses(start_rad)[frame]
        turn = _between(begin[3:], pose[3:])
        steps = max(
            2,
            math.ceil(math.dist(begin[:3], pose[:3]) / _STEP_M),
            math.ceil(2 * math.acos(min(1.0, abs(turn[0]))) / _STEP_RAD),
        )
        points = [np.array(start_rad)]
        for step in range(1, steps + 1):
            share = step / steps
            x, y, z = (a + share * (b - a) for a, b in zip(begin[:3], pose[:3], strict=True))
            try:
                turned = _times(begin[3:], _part(turn, share))
                found = self._geometry.solve(frame, (x, y, z, *turned), points[-1].tolist())
            except GeometryError as error:
                raise Refused("out_of_reach", f"{share:.0%} of the way there: {error}") from error
            points.append(np.array(found))
            if float(np.max(np.abs(points[-1] - points[-2]))) > _LEAP_RAD:
                raise Refused(
                    "not_straight",
                    f"{frame} cannot go straight there: {share:.0%} of the way on the robot would have to take "
                    "another posture; go without straight, or with plan",
                )
        swept = self._geometry.sweep([point.tolist() for point in points])
        if swept.clearance is not None:
            raise Refused("no_room", f"something is in the way: {swept.clearance.text}; go with plan")
        return self._timed(trajectory.resample(np.array(points), _APART_RAD), speed)

    def _timed(self, points: Floats, speed: float) -> Trajectory:
        return trajectory.time_parameterize(points, self._type.joints, speed=speed, step_s=self._type.period_ms / 1000)

    def _clear(self, path_rad: Floats) -> bool:
        return not self._couplings.parted(path_rad) and self._geometry.sweep(path_rad.tolist()).clearance is None


def quaternion_of(
    poses: Mapping[str, Pose], frame: str, quaternion: Quaternion | None, rpy_rad: Vector3 | None
) -> Quaternion:
    """The orientation that is asked for, of length 1; the frame's own where none is.

    Raises:
        Refused: No such frame, both are given, or no direction.
    """
    if frame not in poses:
        raise Refused("unknown_frame", f"no frame '{frame[:80]}'; there are {', '.join(poses)}")
    if quaternion is not None and rpy_rad is not None:
        raise Refused("bad_quaternion", "give a quaternion or rpy_rad, not both")
    if rpy_rad is not None:
        return _from_rpy(rpy_rad)
    w, x, y, z = poses[frame][3:] if quaternion is None else quaternion
    length = math.hypot(w, x, y, z)
    if not _SHORTEST < length < math.inf:
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


def _between(begin: Quaternion, end: Quaternion) -> Quaternion:
    """The shorter turn from one orientation to another, in the first's own axes."""
    w, x, y, z = begin
    turn = _times((w, -x, -y, -z), end)
    sign = math.copysign(1.0, turn[0])
    return (sign * turn[0], sign * turn[1], sign * turn[2], sign * turn[3])


def _part(turn: Quaternion, share: float) -> Quaternion:
    """A share of a turn."""
    w, *axis = turn
    size = math.hypot(*axis)
    if size < _SHORTEST:
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
