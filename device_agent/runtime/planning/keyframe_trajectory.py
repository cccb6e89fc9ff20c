"""Turns keyframes of a movement into one way: joints pass them where they go on, and rest where they turn.

Between two keyframes that name it a joint follows a polynomial of the fifth degree that accelerates at neither. Its
speed where it passes is the harmonic mean of what it needs on both sides, so it never goes back or beyond a place.
``web/src/features/keyframes/model/timeline-layout.ts`` does the same for the preview; ``tests/unit/device_agent/runtime/planning/timelines.json`` holds both equal.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from device_agent.ports.script_calls import Moment, Play
from device_agent.protocol import Joint
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.behaviour_trajectory import confined
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats, Trajectory

FASTEST = 2.0
"""How much faster than their times keyframes can be played."""
LONGEST_S = 600.0
_TRIES = 100
_FITS = 1.0005
_NOTHING = 1e-12
_U = np.linspace(0.0, 1.0, 33)
_FALL_S = 1e-3
"""The least time between two keyframes [s]."""


def _shape(u: Floats) -> Floats:
    """Parts of the way, of the speed at the beginning and of that at the end, in place, speed, acceleration and jerk.

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


_LOOK = _shape(_U)


class Timeline:
    """When the joints are where. From rest to rest.

    Args:
        robot_type: Joints and limits.
        start_rad: Where all joints rest at the beginning, shape (n,) [rad].
        play: Keyframes, whose times count from the beginning, and how many times as fast as they say.

    Attributes:
        limited: What made it slower than asked, as telemetry names it.

    Raises:
        Refused: Times do not rise, a joint is unknown, or one motor would have to do two things.
    """

    def __init__(self, robot_type: RobotType, start_rad: Sequence[float], play: Play) -> None:
        self._type = robot_type
        self._couplings = Couplings(robot_type)
        self._names = [joint.name for joint in robot_type.joints]
        self._gaps_s = _gaps(play) / play.speed
        self._keys: list[list[tuple[int, float]]] = [[(0, place)] for place in start_rad]
        """Of each joint: the number of each keyframe that names it, 0 for the beginning, and the place [rad]."""
        for number, keyframe in enumerate(play.keyframes):
            for name, place in self._led(number + play.first, keyframe).items():
                self._keys[self._names.index(name)].append((number + 1, place))
        asked_s = float(self._gaps_s.sum())
        self._fit()
        self.limited = ("keyframes: later",) if self._gaps_s.sum() > asked_s * _FITS + _FALL_S else ()

    def poses(self) -> list[dict[str, float]]:
        """Where joints are at each keyframe [rad], without those that only follow others."""
        moments = self._moments()[1:]
        places = [_through(self._curve(index), moments)[0] for index in range(len(self._names))]
        followers = {mirror.joint for mirror in self._type.mimic_joints}
        narrowed = {narrowing.joint for narrowing in self._type.position_dependent_limits}
        named = [{number for number, _ in keys} for keys in self._keys]
        return [
            {
                name: float(places[index][number])
                for index, name in enumerate(self._names)
                if name not in followers and (name not in narrowed or number + 1 in named[index])
            }
            for number in range(len(moments))
        ]

    def way(self) -> Trajectory:
        """All of it."""
        step_s = self._type.period_ms / 1000
        lasts_s = float(self._gaps_s.sum())
        times = np.arange(max(2, math.ceil(lasts_s / step_s - _NOTHING) + 1), dtype=np.float64) * step_s
        moved = [_through(self._curve(index), times) for index in range(len(self._names))]
        position, velocity, acceleration = np.array(moved).reshape(len(moved), 3, len(times)).transpose(1, 2, 0)
        velocity[[0, -1]] = acceleration[[0, -1]] = 0.0
        return confined(self._couplings, Trajectory(step_s, position.copy(), velocity, acceleration))

    def _led(self, number: int, keyframe: Moment) -> dict[str, float]:
        unknown = sorted(set(keyframe.position_rad) - set(self._names))
        if unknown:
            where = f"no joint '{unknown[0][:80]}'; there are {', '.join(self._names)}"
            raise Refused("unknown_joint", f"keyframe {number}: {where}")
        led, differing = self._couplings.lead(keyframe.position_rad)
        if differing:
            raise Refused("mirrored", f"keyframe {number}: one motor moves {differing[0]} and another joint")
        return dict(led)

    def _moments(self) -> Floats:
        return np.concatenate(([0.0], np.cumsum(self._gaps_s)))

    def _curve(self, index: int) -> Floats:
        """Time, place and speed at each keyframe that counts for a joint, shape (3, keys)."""
        numbers, places = zip(*self._keys[index], strict=True)
        return _curve(self._moments()[list(numbers)], np.array(places))

    def _fit(self) -> None:
        """Give each gap the time that the limits ask for; a longer one changes the speed in others, hence again."""
        moving = [(joint, keys) for joint, keys in zip(self._type.joints, self._keys, strict=True) if len(keys) > 1]
        for _ in range(_TRIES):
            longer = np.ones_like(self._gaps_s)
            moments = self._moments()
            for joint, keys in moving:
                numbers, places = zip(*keys, strict=True)
                for (begin, end), over in zip(
                    pairwise(numbers), _over(_curve(moments[list(numbers)], np.array(places)), joint), strict=True
                ):
                    longer[begin:end] = np.maximum(longer[begin:end], over)
            if longer.max() <= _FITS:
                return
            self._gaps_s *= np.where(longer > 1, longer, 1.0)
        self._gaps_s *= longer.max()  # all of it slower by as much surely is enough


def _gaps(play: Play) -> Floats:
    reached_s, gaps = 0.0, []
    for number, keyframe in enumerate(play.keyframes, play.first):
        if not reached_s < keyframe.time_s <= LONGEST_S:  # false for NaN
            raise Refused(
                "bad_time",
                f"keyframe {number}: time_s is {keyframe.time_s}; times must rise, to {LONGEST_S:.0f} at most",
            )
        gaps.append(max(_FALL_S, keyframe.time_s - reached_s))
        reached_s = keyframe.time_s
    return np.array(gaps)


def _curve(times: Floats, places: Floats) -> Floats:
    """With the speed at which each place is passed, shape (3, keys)."""
    slopes = np.diff(places) / np.diff(times)
    speeds = np.zeros_like(places)
    before, after = slopes[:-1], slopes[1:]
    on = before * after > 0
    speeds[1:-1][on] = (2 * before[on] * after[on]) / (before[on] + after[on])
    return np.array([times, places, speeds])


def _over(curve: Floats, joint: Joint) -> Floats:
    """How many times as long each stretch of a curve must take for the limits, shape (keys - 1,)."""
    times, places, speeds = curve
    lasts = np.diff(times)
    parts = np.array([np.diff(places), speeds[:-1] * lasts, speeds[1:] * lasts])
    _, velocity, acceleration, jerk = (np.abs(parts.T @ shape).max(axis=1) for shape in _LOOK)
    return np.asarray(
        np.maximum(
            np.maximum(
                velocity / lasts / joint.max_velocity_rad_s,
                np.sqrt(acceleration / lasts**2 / joint.max_acceleration_rad_s2),
            ),
            np.cbrt(jerk / lasts**3 / joint.max_jerk_rad_s3),
        )
    )


def _through(curve: Floats, times: Floats) -> Floats:
    """Position, velocity and acceleration of one joint, shape (3, times). Before and after it rests."""
    moments, places, speeds = curve
    if len(moments) == 1:
        return np.array([np.full_like(times, places[0]), np.zeros_like(times), np.zeros_like(times)])
    begin = np.clip(np.searchsorted(moments, times, side="right") - 1, 0, len(moments) - 2)
    end = begin + 1
    lasts = moments[end] - moments[begin]
    u = np.clip((times - moments[begin]) / lasts, 0.0, 1.0)
    parts = np.array([places[end] - places[begin], speeds[begin] * lasts, speeds[end] * lasts])
    place, velocity, acceleration, _ = (parts * _shape(u)).sum(axis=1)
    low, high = np.minimum(places[begin], places[end]), np.maximum(places[begin], places[end])
    return np.array([np.clip(places[begin] + place, low, high), velocity / lasts, acceleration / lasts**2])
