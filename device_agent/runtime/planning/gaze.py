"""Turns what a robot sees with towards a point: of all ways to look there, the one with the least motion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from device_agent.ports.geometry import RobotGeometry
from device_agent.protocol import Pose, Vector3
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused

_ROUNDS = 60
_NUDGE_RAD = 1e-5
_NEAR_RAD = 5e-4
_DAMPING = 1e-3
_LONGEST_STEP_RAD = 0.3
_NEAREST_M = 1e-3

Array = NDArray[np.float64]


def aim(
    robot_type: RobotType, geometry: RobotGeometry, start_rad: Sequence[float], point_m: Vector3
) -> dict[str, float]:
    """Where the joints of the gaze have to be [rad].

    Args:
        robot_type: With a ``gaze``, which names frame, axis and joints.
        geometry: The robot's shape.
        start_rad: Where all joints are, shape (n,) [rad].
        point_m: The point in the robot's base frame [m].

    Raises:
        Refused: It cannot look there.
    """
    gaze = robot_type.gaze
    if gaze is None:
        raise Refused("cannot", "this robot has no gaze")
    names = [joint.name for joint in robot_type.joints]
    turning = [names.index(name) for name in gaze.joints]
    lower = np.array([robot_type.joints[index].lower_rad for index in turning])
    upper = np.array([robot_type.joints[index].upper_rad for index in turning])
    axis = np.array(gaze.axis) / np.linalg.norm(gaze.axis)

    def error(joints: Array) -> Array:
        """From where it looks to where it should, as unit vectors, one frame after the other."""
        position = np.array(start_rad, dtype=float)
        position[turning] = joints
        poses = geometry.poses(position.tolist())
        return np.concatenate([_beside(poses[frame], axis, point_m) for frame in (gaze.frame, *gaze.additional_frames)])

    joints = np.clip(np.array(start_rad, dtype=float)[turning], lower, upper)
    for _ in range(_ROUNDS):
        now = error(joints)
        if float(np.linalg.norm(now)) < _NEAR_RAD:
            return {names[index]: float(value) for index, value in zip(turning, joints, strict=True)}
        slopes = np.column_stack(
            [(error(joints + step) - now) / _NUDGE_RAD for step in np.eye(len(turning)) * _NUDGE_RAD]
        )
        # Far from the point much damping: else eyes and neck turn against one another, which changes next to nothing.
        square = slopes @ slopes.T + (_DAMPING + float(now @ now)) * np.eye(len(now))
        step = -slopes.T @ np.linalg.solve(square, now)
        joints = np.clip(
            joints + step * min(1.0, _LONGEST_STEP_RAD / max(float(np.abs(step).max()), 1e-12)), lower, upper
        )
    raise Refused("out_of_reach", f"{', '.join(gaze.joints)} cannot turn far enough to look there")


def _beside(pose: Pose, axis: Array, point_m: Vector3) -> Array:
    """From where a frame looks to where it should, as unit vectors."""
    way = np.array(point_m) - np.array(pose[:3])
    far = float(np.linalg.norm(way))
    if far < _NEAREST_M:
        raise Refused("out_of_reach", "the point is inside of what it looks with")
    return np.asarray(way / far - _turned(pose, axis))


def _turned(pose: Pose, axis: Array) -> Array:
    """An axis of a frame, in the base."""
    w, vector = pose[3], np.array(pose[4:])
    around = 2 * np.cross(vector, axis)
    return np.asarray(axis + w * around + np.cross(vector, around))
