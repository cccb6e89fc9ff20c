"""Turns keyframes and speech into one way through joint space: where every joint is to be at each moment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from device_agent.protocol import Joint
from device_agent.protocol.manifests.capabilities import Keyframe
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.planning import visemes as mouth
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats, Trajectory

_SYLLABLE_S = 0.12
"""Mouth shapes nearer to each other than this run into one, as they do in people."""
_CLOSES_S = 0.2
_SAME_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Line:
    """What is said in a behaviour: when it begins [s], the text, and how long it takes [s]."""

    begin_s: float
    text: str
    duration_s: float


class BehaviourTrajectory:
    """Where joints are to be when. Each goes from rest to rest, within its limits, and so never beyond its places.

    Args:
        robot_type: Joints, limits, visemes.
        start_rad: Where all joints rest at the beginning, shape (n,) [rad].
    """

    def __init__(self, robot_type: RobotType, start_rad: Sequence[float]) -> None:
        self._type = robot_type
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._couplings = Couplings(robot_type)
        self._points: list[list[tuple[float, float]]] = [[(0.0, place)] for place in start_rad]
        self._now_s = 0.0
        self._end_s = 0.0

    def keyframes(self, keyframes: Sequence[Keyframe], said_s: Mapping[str, float]) -> list[Line]:
        """Add a behaviour; gives what is said when.

        Args:
            keyframes: Of the robot type.
            said_s: Text → how long it takes to say [s].
        """
        lines = []
        for keyframe in keyframes:
            if keyframe.say:
                lines.append(Line(self._now_s, keyframe.say, said_s[keyframe.say]))
            led, _ = self._couplings.lead(keyframe.position_rad)
            targets = {self._index[name]: value for name, value in led.items()}
            needs_s = max((self._needs_s(index, value) for index, value in targets.items()), default=0.0)
            reached_s = max(keyframe.time_s, self._now_s + needs_s)
            for index, value in targets.items():
                self._reach(index, self._now_s, reached_s, value)
            self._now_s = reached_s
        self._end_s = max(self._end_s, self._now_s)
        for line in lines:
            self.speak(line)
        return lines

    def speak(self, line: Line) -> None:
        """Add the mouth shapes of what is said: as wide as there is time for, while nothing else moves the joint."""
        visemes = self._type.visemes
        self._end_s = max(self._end_s, line.begin_s + line.duration_s)
        shapes = _spread(mouth.visemes_of(line.text, line.duration_s, visemes))
        for name in dict.fromkeys(joint for shape in visemes.values() for joint in shape):
            index = self._index[name]
            joint, home_rad = self._type.joints[index], self._type.home_rad[name]
            begin_s, moves_s = self._rests(index, line.begin_s)
            base = self._at(index, begin_s)
            points = [point for point in self._points[index] if point[0] < begin_s] + [(begin_s, base)]
            for time_s, shape in shapes:
                moment_s = line.begin_s + time_s
                since_s, place = points[-1]
                most = _most_rad(joint, max(0.0, moment_s - since_s))
                place += min(max(visemes[shape].get(name, home_rad) - place, -most), most)
                if moment_s > since_s and moment_s + _needs_s(joint, abs(place - base)) <= moves_s:
                    points.append((moment_s, place))
            needs_s = _needs_s(joint, abs(points[-1][1] - base))
            closed_s = min(max(line.begin_s + line.duration_s + _CLOSES_S, points[-1][0] + needs_s), moves_s)
            points.append((closed_s, base))
            self._points[index] = points + [point for point in self._points[index] if point[0] >= moves_s]
            self._end_s = max(self._end_s, closed_s)

    def _rests(self, index: int, from_s: float) -> tuple[float, float]:
        """From when on a joint rests, and until when [s]."""
        for (begin_s, place), (end_s, following) in pairwise(self._points[index]):
            if place != following and begin_s < from_s < end_s:
                from_s = end_s
            elif place != following and begin_s >= from_s:
                return from_s, begin_s
        return from_s, math.inf

    def way(self) -> Trajectory:
        """All of it, from rest to rest."""
        step_s = self._type.period_ms / 1000
        times = np.arange(max(2, math.ceil(self._end_s / step_s) + 1), dtype=np.float64) * step_s
        moved = [_through(points, times) for points in self._points]
        shape = (len(moved), 3, len(times))
        position, velocity, acceleration = np.array(moved).reshape(shape).transpose(1, 2, 0)
        return confined(self._couplings, Trajectory(step_s, position, velocity, acceleration))

    def _needs_s(self, index: int, place: float) -> float:
        return _needs_s(self._type.joints[index], abs(place - self._points[index][-1][1]))

    def _reach(self, index: int, begin_s: float, end_s: float, place: float) -> None:
        points = self._points[index]
        if begin_s > points[-1][0]:
            points.append((begin_s, points[-1][1]))
        points.append((end_s, place))

    def _at(self, index: int, time_s: float) -> float:
        return float(_through(self._points[index], np.array([time_s]))[0][0])


def confined(couplings: Couplings, way: Trajectory) -> Trajectory:
    """A way on which joints that hang together stay together; ``way`` is changed."""
    position, velocity, acceleration = way.position_rad, way.velocity_rad_s, way.acceleration_rad_s2
    before = position.copy()
    couplings.confine(position)
    for index in np.flatnonzero(np.any(position != before, axis=0)):
        velocity[:, index] = np.gradient(position[:, index], way.step_s)
        velocity[[0, -1], index] = 0.0
        acceleration[:, index] = np.gradient(velocity[:, index], way.step_s)
    return way


def _spread(shapes: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Shapes with time between them: of those that are too near the later one counts, but for rest."""
    kept: list[tuple[float, str]] = []
    for time_s, shape in shapes:
        if kept and time_s - kept[-1][0] < _SYLLABLE_S:
            if shape in mouth.VOWELS and kept[-1][1] not in mouth.VOWELS and len(kept) > 1:
                kept[-1] = (kept[-1][0], shape)
            continue
        kept.append((time_s, shape))
    return kept


def _needs_s(joint: Joint, way_rad: float) -> float:
    """The least time for a way from rest to rest with the law of ``_through`` [s]."""
    return max(
        2 * way_rad / joint.max_velocity_rad_s,
        math.sqrt(8 * way_rad / joint.max_acceleration_rad_s2),
        math.cbrt(32 * way_rad / joint.max_jerk_rad_s3),
    )


def _most_rad(joint: Joint, time_s: float) -> float:
    """The longest way that takes no longer [rad]."""
    return min(
        joint.max_velocity_rad_s * time_s / 2,
        joint.max_acceleration_rad_s2 * time_s**2 / 8,
        joint.max_jerk_rad_s3 * time_s**3 / 32,
    )


def _through(points: Sequence[tuple[float, float]], times: Floats) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and acceleration of one joint, from rest to rest between points, in four jerks."""
    moments, places = np.array(points).T
    before = np.clip(np.searchsorted(moments, times, side="right") - 1, 0, len(moments) - 1)
    after = np.minimum(before + 1, len(moments) - 1)
    lasts = np.maximum(moments[after] - moments[before], _SAME_RAD)
    way, u = places[after] - places[before], (times - moments[before]) / lasts
    u = np.where(after == before, 0.0, np.clip(u, 0.0, 1.0))
    x, rest = u - 0.25, 1 - u
    early, late = u < 0.25, u > 0.75  # noqa: PLR2004 (quarters)
    share = np.select([early, late], [16 / 3 * u**3, 1 - 16 / 3 * rest**3], 1 / 12 + x + 4 * x**2 - 16 / 3 * x**3)
    speed = np.select([early, late], [16 * u**2, 16 * rest**2], 1 + 8 * x - 16 * x**2)
    change = np.select([early, late], [32 * u, -32 * rest], 8 - 32 * x)
    return places[before] + way * share, way / lasts * speed, way / lasts**2 * change
