"""Gaze: joint positions with which a robot looks at a point, with the least motion."""

from collections.abc import Sequence

import numpy as np

from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Pose, Vector3
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.trajectory import Floats

_ITERATIONS = 60
_STEP_RAD = 1e-5
_NEAR_RAD = 5e-4
_DAMPING = 1e-3
_MAX_STEP_RAD = 0.3
_MIN_DISTANCE_M = 1e-3


def solve_gaze(
    robot_type: RobotType, geometry: RobotGeometry, start_rad: Sequence[float], point_m: Vector3
) -> dict[str, float]:
    """Positions of the gaze joints [rad].

    Args:
        robot_type: Its ``gaze`` names frame, axis and joints.
        geometry: Shape of the robot.
        start_rad: Present positions of all joints, shape (n,) [rad].
        point_m: The point in the robot's base frame [m].

    Raises:
        Refused: The robot cannot look there.
    """
    gaze = robot_type.gaze
    if gaze is None:
        raise Refused("cannot", "this robot has no gaze")
    names = [joint.name for joint in robot_type.joints]
    turning = [names.index(name) for name in gaze.joints]
    lower = np.array([robot_type.joints[index].lower_rad for index in turning])
    upper = np.array([robot_type.joints[index].upper_rad for index in turning])
    axis = np.array(gaze.axis) / np.linalg.norm(gaze.axis)

    def error(joints: Floats) -> Floats:
        """Differences between actual and required viewing directions, frame after frame."""
        position = np.array(start_rad, dtype=float)
        position[turning] = joints
        poses = geometry.poses(position.tolist())
        return np.concatenate(
            [_direction_error(poses[frame], axis, point_m) for frame in (gaze.frame, *gaze.additional_frames)]
        )

    joints = np.clip(np.array(start_rad, dtype=float)[turning], lower, upper)
    for _ in range(_ITERATIONS):
        current = error(joints)
        if float(np.linalg.norm(current)) < _NEAR_RAD:
            return {names[index]: float(value) for index, value in zip(turning, joints, strict=True)}
        slopes = np.column_stack(
            [(error(joints + step) - current) / _STEP_RAD for step in np.eye(len(turning)) * _STEP_RAD]
        )
        # Strong damping far from the point prevents eyes and neck from turning against each other.
        square = slopes @ slopes.T + (_DAMPING + float(current @ current)) * np.eye(len(current))
        step = -slopes.T @ np.linalg.solve(square, current)
        joints = np.clip(joints + step * min(1.0, _MAX_STEP_RAD / max(float(np.abs(step).max()), 1e-12)), lower, upper)
    raise Refused("out_of_reach", f"{', '.join(gaze.joints)} cannot turn far enough to look there")


def _direction_error(pose: Pose, axis: Floats, point_m: Vector3) -> Floats:
    """Difference between the actual and the required viewing direction of a frame, as unit vectors."""
    offset = np.array(point_m) - np.array(pose[:3])
    distance = float(np.linalg.norm(offset))
    if distance < _MIN_DISTANCE_M:
        raise Refused("out_of_reach", "the point is inside the frame that looks")
    return np.asarray(offset / distance - _rotated(pose, axis))


def _rotated(pose: Pose, axis: Floats) -> Floats:
    """An axis of a frame, in the base frame."""
    w, vector = pose[3], np.array(pose[4:])
    around = 2 * np.cross(vector, axis)
    return np.asarray(axis + w * around + np.cross(vector, around))
