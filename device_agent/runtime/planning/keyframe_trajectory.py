"""Converts the keyframes of a movement into one trajectory.

A joint passes a keyframe if its motion continues, and rests where it reverses. Between two keyframes that name it, it
follows a quintic polynomial with zero acceleration at both. Its speed at a keyframe is the harmonic mean of the mean
speeds on both sides, so it never overshoots.
``web/src/features/keyframes/model/timeline-layout.ts`` computes the same for the preview. Tests compare both with
``tests/unit/device_agent/runtime/planning/timelines.json``.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from device_agent.ports.script_calls import Play, PlayKeyframe
from device_agent.protocol import Joint
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.behaviour_trajectory import constrain
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats, Trajectory

MAX_SPEED = 2.0
"""Maximum speed factor of keyframes."""
MAX_DURATION_S = 600.0
_ITERATIONS = 100
_TOLERANCE = 1.0005
_EPSILON = 1e-12
_U = np.linspace(0.0, 1.0, 33)
_MIN_GAP_S = 1e-3
"""Minimum time between two keyframes [s]."""


def _shape(u: Floats) -> Floats:
    """Basis functions of distance, start speed and end speed, and their first three derivatives.

    Returns:
        Shape (4, 3, len(u)).
    """
    powers = np.array([u**power for power in range(6)])
    parts = np.array([[0, 0, 0, 10, -15, 6], [0, 1, 0, -6, 8, -3], [0, 0, 0, -4, 7, -3]], dtype=np.float64)
    shapes = []
    for _ in range(4):
        shapes.append(parts @ powers[: parts.shape[1]])
        parts = parts[:, 1:] * np.arange(1, parts.shape[1])
    return np.array(shapes)


_SHAPE = _shape(_U)


class KeyframeTrajectory:
    """Trajectory through keyframes, from rest to rest.

    Attributes:
        limited: Limits that made it slower than requested, as telemetry names them.

    Raises:
        Refused: Times do not increase, a joint is unknown, or positions contradict a mimic joint.
    """

    def __init__(self, robot_type: RobotType, start_rad: Sequence[float], play: Play) -> None:
        self._type = robot_type
        self._couplings = Couplings(robot_type)
        self._names = [joint.name for joint in robot_type.joints]
        self._gaps_s = _gaps(play) / play.speed
        self._keys: list[list[tuple[int, float]]] = [[(0, position)] for position in start_rad]
        """Of each joint: numbers of the keyframes that name it, 0 for the start, and its positions [rad]."""
        for number, keyframe in enumerate(play.keyframes):
            for name, position in self._leaders(number + play.first, keyframe).items():
                self._keys[self._names.index(name)].append((number + 1, position))
        requested_s = float(self._gaps_s.sum())
        self._fit()
        self.limited = ("keyframes: later",) if self._gaps_s.sum() > requested_s * _TOLERANCE + _MIN_GAP_S else ()

    def poses(self) -> list[dict[str, float]]:
        """Positions of the joints at each keyframe [rad], without mimic joints."""
        key_times = self._key_times()[1:]
        positions = [_interpolate(self._curve(index), key_times)[0] for index in range(len(self._names))]
        followers = {mirror.joint for mirror in self._type.mimic_joints}
        narrowed = {narrowing.joint for narrowing in self._type.position_dependent_limits}
        named = [{number for number, _ in keys} for keys in self._keys]
        return [
            {
                name: float(positions[index][number])
                for index, name in enumerate(self._names)
                if name not in followers and (name not in narrowed or number + 1 in named[index])
            }
            for number in range(len(key_times))
        ]

    def trajectory(self) -> Trajectory:
        """The complete trajectory."""
        step_s = self._type.period_ms / 1000
        duration_s = float(self._gaps_s.sum())
        times = np.arange(max(2, math.ceil(duration_s / step_s - _EPSILON) + 1), dtype=np.float64) * step_s
        curves = [_interpolate(self._curve(index), times) for index in range(len(self._names))]
        position, velocity, acceleration = np.array(curves).reshape(len(curves), 3, len(times)).transpose(1, 2, 0)
        velocity[[0, -1]] = acceleration[[0, -1]] = 0.0
        return constrain(self._couplings, Trajectory(step_s, position.copy(), velocity, acceleration))

    def _leaders(self, number: int, keyframe: PlayKeyframe) -> dict[str, float]:
        unknown = sorted(set(keyframe.position_rad) - set(self._names))
        if unknown:
            message = f"no joint '{unknown[0][:80]}'; there are {', '.join(self._names)}"
            raise Refused("unknown_joint", f"keyframe {number}: {message}")
        leaders, differing = self._couplings.resolve_leaders(keyframe.position_rad)
        if differing:
            raise Refused("mirrored", f"keyframe {number}: one motor moves {differing[0]} and another joint")
        return dict(leaders)

    def _key_times(self) -> Floats:
        return np.concatenate(([0.0], np.cumsum(self._gaps_s)))

    def _curve(self, index: int) -> Floats:
        """Time, position and speed of a joint at the keyframes that name it, shape (3, keys)."""
        numbers, positions = zip(*self._keys[index], strict=True)
        return _curve(self._key_times()[list(numbers)], np.array(positions))

    def _fit(self) -> None:
        """Lengthen gaps until the limits are met; each change affects the speed in other gaps, so it iterates."""
        moving = [(joint, keys) for joint, keys in zip(self._type.joints, self._keys, strict=True) if len(keys) > 1]
        for _ in range(_ITERATIONS):
            longer = np.ones_like(self._gaps_s)
            key_times = self._key_times()
            for joint, keys in moving:
                numbers, positions = zip(*keys, strict=True)
                for (start, end), factor in zip(
                    pairwise(numbers),
                    _stretch(_curve(key_times[list(numbers)], np.array(positions)), joint),
                    strict=True,
                ):
                    longer[start:end] = np.maximum(longer[start:end], factor)
            if longer.max() <= _TOLERANCE:
                return
            self._gaps_s *= np.where(longer > 1, longer, 1.0)
        self._gaps_s *= longer.max()  # slowing down everything by the largest factor is sufficient


def _gaps(play: Play) -> Floats:
    reached_s, gaps = 0.0, []
    for number, keyframe in enumerate(play.keyframes, play.first):
        if not reached_s < keyframe.time_s <= MAX_DURATION_S:  # false for NaN
            raise Refused(
                "bad_time",
                f"keyframe {number}: time_s is {keyframe.time_s}; times must increase, up to {MAX_DURATION_S:.0f}",
            )
        gaps.append(max(_MIN_GAP_S, keyframe.time_s - reached_s))
        reached_s = keyframe.time_s
    return np.array(gaps)


def _curve(times: Floats, positions: Floats) -> Floats:
    """Times, positions and the speeds at them, shape (3, keys)."""
    slopes = np.diff(positions) / np.diff(times)
    speeds = np.zeros_like(positions)
    before, after = slopes[:-1], slopes[1:]
    on = before * after > 0
    speeds[1:-1][on] = (2 * before[on] * after[on]) / (before[on] + after[on])
    return np.array([times, positions, speeds])


def _stretch(curve: Floats, joint: Joint) -> Floats:
    """Factor by which each gap of a curve must be lengthened for the limits, shape (keys - 1,)."""
    times, positions, speeds = curve
    durations = np.diff(times)
    parts = np.array([np.diff(positions), speeds[:-1] * durations, speeds[1:] * durations])
    _, velocity, acceleration, jerk = (np.abs(parts.T @ shape).max(axis=1) for shape in _SHAPE)
    return np.asarray(
        np.maximum(
            np.maximum(
                velocity / durations / joint.max_velocity_rad_s,
                np.sqrt(acceleration / durations**2 / joint.max_acceleration_rad_s2),
            ),
            np.cbrt(jerk / durations**3 / joint.max_jerk_rad_s3),
        )
    )


def _interpolate(curve: Floats, times: Floats) -> Floats:
    """Position, velocity and acceleration of one joint, shape (3, times). It rests before and after the curve."""
    key_times, positions, speeds = curve
    if len(key_times) == 1:
        return np.array([np.full_like(times, positions[0]), np.zeros_like(times), np.zeros_like(times)])
    start = np.clip(np.searchsorted(key_times, times, side="right") - 1, 0, len(key_times) - 2)
    end = start + 1
    durations = key_times[end] - key_times[start]
    u = np.clip((times - key_times[start]) / durations, 0.0, 1.0)
    parts = np.array([positions[end] - positions[start], speeds[start] * durations, speeds[end] * durations])
    displacement, velocity, acceleration, _ = (parts * _shape(u)).sum(axis=1)
    low, high = np.minimum(positions[start], positions[end]), np.maximum(positions[start], positions[end])
    return np.array(
        [np.clip(positions[start] + displacement, low, high), velocity / durations, acceleration / durations**2]
    )
