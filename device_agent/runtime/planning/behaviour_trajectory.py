"""Converts the keyframes and speech of a behaviour into one joint-space trajectory."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from device_agent.protocol import Joint
from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.planning import visemes
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats, Trajectory

_MIN_VISEME_GAP_S = 0.12
"""Mouth shapes closer together merge into one, as in human speech [s]."""
_CLOSING_S = 0.2
_SAME_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class SpokenLine:
    """A spoken line of a behaviour: start [s], text, duration [s]."""

    start_s: float
    text: str
    duration_s: float


class BehaviourTrajectory:
    """Positions of the joints over time. Each joint moves from rest to rest, so it never overshoots its positions."""

    def __init__(self, robot_type: RobotType, start_rad: Sequence[float]) -> None:
        self._type = robot_type
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._couplings = Couplings(robot_type)
        self._points: list[list[tuple[float, float]]] = [[(0.0, position)] for position in start_rad]
        self._now_s = 0.0
        self._end_s = 0.0

    def add_keyframes(self, keyframes: Sequence[Keyframe], durations_s: Mapping[str, float]) -> list[SpokenLine]:
        """Add a behaviour with the speaking time of each text [s]; returns its spoken lines."""
        lines = []
        for keyframe in keyframes:
            if keyframe.say:
                lines.append(SpokenLine(self._now_s, keyframe.say, durations_s[keyframe.say]))
            leaders, _ = self._couplings.resolve_leaders(keyframe.position_rad)
            targets = {self._index[name]: value for name, value in leaders.items()}
            duration_s = max((self._duration_s(index, value) for index, value in targets.items()), default=0.0)
            reached_s = max(keyframe.time_s, self._now_s + duration_s)
            for index, value in targets.items():
                self._add_motion(index, self._now_s, reached_s, value)
            self._now_s = reached_s
        self._end_s = max(self._end_s, self._now_s)
        for line in lines:
            self.add_speech(line)
        return lines

    def add_speech(self, line: SpokenLine) -> None:
        """Add the mouth shapes of a line, as wide as time allows, while keyframes do not move the joint."""
        poses = self._type.visemes
        self._end_s = max(self._end_s, line.start_s + line.duration_s)
        shapes = _merge_close(visemes.visemes_of(line.text, line.duration_s, poses))
        for name in dict.fromkeys(joint for shape in poses.values() for joint in shape):
            index = self._index[name]
            joint, home_rad = self._type.joints[index], self._type.home_rad[name]
            start_s, end_s = self._rest_interval(index, line.start_s)
            base = self._position_at(index, start_s)
            points = [point for point in self._points[index] if point[0] < start_s] + [(start_s, base)]
            for time_s, shape in shapes:
                moment_s = line.start_s + time_s
                since_s, position = points[-1]
                limit = _max_distance_rad(joint, max(0.0, moment_s - since_s))
                position += min(max(poses[shape].get(name, home_rad) - position, -limit), limit)
                if moment_s > since_s and moment_s + _min_duration_s(joint, abs(position - base)) <= end_s:
                    points.append((moment_s, position))
            closing_s = _min_duration_s(joint, abs(points[-1][1] - base))
            closed_s = min(max(line.start_s + line.duration_s + _CLOSING_S, points[-1][0] + closing_s), end_s)
            points.append((closed_s, base))
            self._points[index] = points + [point for point in self._points[index] if point[0] >= end_s]
            self._end_s = max(self._end_s, closed_s)

    def _rest_interval(self, index: int, from_s: float) -> tuple[float, float]:
        """Start and end of the next interval in which a joint rests [s]."""
        for (start_s, position), (end_s, following) in pairwise(self._points[index]):
            if position != following and start_s < from_s < end_s:
                from_s = end_s
            elif position != following and start_s >= from_s:
                return from_s, start_s
        return from_s, math.inf

    def trajectory(self) -> Trajectory:
        """The complete trajectory, from rest to rest."""
        step_s = self._type.period_ms / 1000
        times = np.arange(max(2, math.ceil(self._end_s / step_s) + 1), dtype=np.float64) * step_s
        curves = [_interpolate(points, times) for points in self._points]
        shape = (len(curves), 3, len(times))
        position, velocity, acceleration = np.array(curves).reshape(shape).transpose(1, 2, 0)
        return constrain(self._couplings, Trajectory(step_s, position, velocity, acceleration))

    def _duration_s(self, index: int, position: float) -> float:
        return _min_duration_s(self._type.joints[index], abs(position - self._points[index][-1][1]))

    def _add_motion(self, index: int, start_s: float, end_s: float, position: float) -> None:
        points = self._points[index]
        if start_s > points[-1][0]:
            points.append((start_s, points[-1][1]))
        points.append((end_s, position))

    def _position_at(self, index: int, time_s: float) -> float:
        return float(_interpolate(self._points[index], np.array([time_s]))[0][0])


def constrain(couplings: Couplings, trajectory: Trajectory) -> Trajectory:
    """Apply joint couplings to a trajectory, in place."""
    position, velocity = trajectory.position_rad, trajectory.velocity_rad_s
    acceleration = trajectory.acceleration_rad_s2
    before = position.copy()
    couplings.confine(position)
    for index in np.flatnonzero(np.any(position != before, axis=0)):
        velocity[:, index] = np.gradient(position[:, index], trajectory.step_s)
        velocity[[0, -1], index] = 0.0
        acceleration[:, index] = np.gradient(velocity[:, index], trajectory.step_s)
    return trajectory


def _merge_close(shapes: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Shapes with a minimum gap. Of close shapes the first is merged, but a vowel replaces a consonant."""
    merged: list[tuple[float, str]] = []
    for time_s, shape in shapes:
        if merged and time_s - merged[-1][0] < _MIN_VISEME_GAP_S:
            if shape in visemes.VOWELS and merged[-1][1] not in visemes.VOWELS and len(merged) > 1:
                merged[-1] = (merged[-1][0], shape)
            continue
        merged.append((time_s, shape))
    return merged


def _min_duration_s(joint: Joint, distance_rad: float) -> float:
    """Minimum duration of a motion from rest to rest with the profile of ``_interpolate`` [s]."""
    return max(
        2 * distance_rad / joint.max_velocity_rad_s,
        math.sqrt(8 * distance_rad / joint.max_acceleration_rad_s2),
        math.cbrt(32 * distance_rad / joint.max_jerk_rad_s3),
    )


def _max_distance_rad(joint: Joint, time_s: float) -> float:
    """Maximum distance of a motion in this time [rad]."""
    return min(
        joint.max_velocity_rad_s * time_s / 2,
        joint.max_acceleration_rad_s2 * time_s**2 / 8,
        joint.max_jerk_rad_s3 * time_s**3 / 32,
    )


def _interpolate(points: Sequence[tuple[float, float]], times: Floats) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and acceleration of one joint, from rest to rest between points, in four phases of jerk."""
    times_s, positions = np.array(points).T
    before = np.clip(np.searchsorted(times_s, times, side="right") - 1, 0, len(times_s) - 1)
    after = np.minimum(before + 1, len(times_s) - 1)
    durations = np.maximum(times_s[after] - times_s[before], _SAME_RAD)
    distance, u = positions[after] - positions[before], (times - times_s[before]) / durations
    u = np.where(after == before, 0.0, np.clip(u, 0.0, 1.0))
    x, rest = u - 0.25, 1 - u
    early, late = u < 0.25, u > 0.75  # noqa: PLR2004 (quarters)
    share = np.select([early, late], [16 / 3 * u**3, 1 - 16 / 3 * rest**3], 1 / 12 + x + 4 * x**2 - 16 / 3 * x**3)
    speed = np.select([early, late], [16 * u**2, 16 * rest**2], 1 + 8 * x - 16 * x**2)
    change = np.select([early, late], [32 * u, -32 * rest], 8 - 32 * x)
    return positions[before] + distance * share, distance / durations * speed, distance / durations**2 * change
