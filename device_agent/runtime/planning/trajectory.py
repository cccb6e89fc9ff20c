"""Ways through joint space: corners rounded off, and a time for each place at which no joint exceeds its limits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from device_agent.protocol import Joint

Floats = npt.NDArray[np.float64]

_ROUNDING_RAD = (0.8, 0.5, 0.3, 0.2, 0.12, 0.08, 0.05, 0.03)
"""How far apart the points are that draw a way round a corner: the first that leaves it clear counts."""
_LOOKS = 4
"""Places of each span of the spline between which the way is looked at."""
_LEGS = 8
"""Legs of a way that are looked at together: few things are near a short way."""
_GRID = 16
"""Places of each span for which a speed is found."""
_TURNING = 0.5
"""Share of acceleration and jerk that bends may use; the rest is for speeding up and slowing down in them."""
_STEP_S = 0.001
_FITS = 1.005
_TRIES = 10
_NOTHING = 1e-9
# A uniform cubic B-spline in one span: rows for 1, u, u², u³ of the share of the span, columns for its four points.
_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Where all joints are at each moment of a motion from rest to rest.

    Attributes:
        step_s: Time between two samples [s].
        position_rad: Shape (samples, n) [rad].
        velocity_rad_s: Shape (samples, n) [rad/s].
        acceleration_rad_s2: Shape (samples, n) [rad/s²].
    """

    step_s: float
    position_rad: Floats
    velocity_rad_s: Floats
    acceleration_rad_s2: Floats

    @property
    def duration_s(self) -> float:
        """How long it takes when nothing slows it [s]."""
        return (len(self.position_rad) - 1) * self.step_s

    def at(self, time_s: float) -> tuple[Floats, Floats, Floats]:
        """Position, velocity and acceleration, shape (n,) each; before its beginning and after its end it rests."""
        place = min(max(time_s / self.step_s, 0.0), len(self.position_rad) - 1.0)
        index = min(int(place), len(self.position_rad) - 2)
        u = place - index
        begin, end = self.position_rad[index : index + 2]
        rise, fall = self.velocity_rad_s[index : index + 2]
        way, a, b = end - begin, rise * self.step_s, fall * self.step_s
        position = begin + u * (a + u * ((3 * way - 2 * a - b) + u * (a + b - 2 * way)))
        acceleration = (1 - u) * self.acceleration_rad_s2[index] + u * self.acceleration_rad_s2[index + 1]
        return position, rise + u * (fall - rise), acceleration


def blend_corners(corners: Sequence[Sequence[float]], clear: Callable[[Floats], bool]) -> Floats | None:
    """The points of a spline that goes from corner to corner, and rounds off those between as widely as there is room.

    Args:
        corners: At least two positions, shape (n,) [rad] each.
        clear: Whether some positions, shape (k, n), and the straight ways from each to the next are clear.

    Returns:
        The points, shape (points, n); ``None`` when not even the narrowest is clear.
    """
    path = np.array(corners, dtype=np.float64)
    for rounding_rad in _ROUNDING_RAD:
        points = resample(path, rounding_rad)
        places = _along(points, _LOOKS)[0]
        if all(clear(places[index : index + _LEGS + 1]) for index in range(0, len(places) - 1, _LEGS)):
            return points
    return None


def resample(path: Floats, apart_rad: float) -> Floats:
    """Points on a path from corner to corner that are equally far apart, no further than ``apart_rad``.

    A spline through points that are here near and there far apart would hurry and hesitate.
    """
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))
    count = max(1, int(np.ceil(lengths[-1] / apart_rad)))
    places = np.linspace(0.0, lengths[-1], count + 1)
    points: Floats = np.stack([np.interp(places, lengths, joint) for joint in path.T], axis=1)
    points[0], points[-1] = path[0], path[-1]
    return points


def time_parameterize(points: Floats, joints: Sequence[Joint], *, speed: float, step_s: float) -> Trajectory:
    """When to be where on a spline: as fast as each joint's velocity, acceleration and jerk allow.

    The speed along the spline is the highest that its bends allow, reached and left at the acceleration that is left,
    then evened out over the time in which jerk builds it up.

    Args:
        points: Of the spline, shape (points, n) [rad].
        joints: Their limits.
        speed: Share of each joint's velocity limit, above 0 and at most 1.
        step_s: Time between two samples of the way [s].
    """
    limits = np.array(
        [(joint.max_velocity_rad_s * speed, joint.max_acceleration_rad_s2, joint.max_jerk_rad_s3) for joint in joints]
    ).T
    ramp_s = float(np.max(limits[1] / limits[2]))
    allowed = limits.copy()
    for _ in range(_TRIES):
        places = _spread(points, _law(points, allowed), ramp_s)
        velocity_over, acceleration_over, jerk_over = _over(places, limits)
        over = max(velocity_over, acceleration_over**0.5)
        if max(over, jerk_over) <= _FITS:
            break
        if over > _FITS:
            allowed /= np.array([[over], [over**2], [over**3]])
        ramp_s *= max(1.0, jerk_over)
    every = max(1, round(step_s / _STEP_S))
    places = np.concatenate((places, np.repeat(places[-1:], -(len(places) - 1) % every, axis=0)))
    velocity = np.gradient(places, _STEP_S, axis=0)
    acceleration = np.gradient(velocity, _STEP_S, axis=0)
    velocity[[0, -1]] = acceleration[[0, -1]] = 0.0
    return Trajectory(every * _STEP_S, places[::every], velocity[::every], acceleration[::every])


def _along(points: Floats, parts: int) -> tuple[Floats, Floats, Floats, Floats]:
    """The spline and its first three derivatives at so many places a span and at its end, shape (places, n) each."""
    spans = len(points) - 1
    return _spline(points, np.linspace(0.0, spans, spans * parts + 1))


def _spline(points: Floats, places: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    # Mirrored ends: the spline begins and ends in its first and last point.
    whole = np.concatenate(([2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]))
    index = np.minimum(places.astype(np.intp), len(points) - 2)
    u = (places - index)[:, np.newaxis]
    near = whole[index[:, np.newaxis] + np.arange(4)]
    one, two, three, four = (np.einsum("c,pcn->pn", row, near) for row in _SPLINE)
    return (
        one + u * (two + u * (three + u * four)),
        two + u * (2 * three + 3 * u * four),
        2 * three + 6 * u * four,
        6 * four,
    )


def _law(points: Floats, limits: Floats) -> tuple[Floats, Floats]:
    """Places of the spline and the times at which to be there [s], at no more than the acceleration."""
    _, first, second, third = (np.abs(part) + _NOTHING for part in _along(points, _GRID))
    velocity, acceleration, jerk = limits
    bends = np.minimum(np.sqrt(_TURNING * acceleration / second), np.cbrt(_TURNING * jerk / third))
    fastest = np.min(np.minimum(velocity / first, bends), axis=1)
    gain = np.min((acceleration - second * fastest[:, np.newaxis] ** 2) / first, axis=1)
    square = fastest**2
    square[[0, -1]] = 0.0
    for order in (range(1, len(square)), range(len(square) - 2, -1, -1)):
        step = order.step
        for index in order:
            square[index] = min(square[index], square[index - step] + 2 * gain[index - step] / _GRID)
    speed = np.sqrt(square)
    return np.arange(len(square)) / _GRID, np.concatenate(([0.0], np.cumsum(2 / _GRID / (speed[1:] + speed[:-1]))))


def _spread(points: Floats, law: tuple[Floats, Floats], ramp_s: float) -> Floats:
    """Where to be every ``_STEP_S``, with accelerations that take ``ramp_s`` to build up, shape (samples, n)."""
    places, times = law
    width = max(1, round(ramp_s / _STEP_S))
    moments: Floats = np.arange(-width, int(times[-1] / _STEP_S) + 2 * width, dtype=np.float64) * _STEP_S
    # Between two places the acceleration is constant: the place is a parabola of time there, not a line.
    resample = np.convolve(
        _parabolas(places, times, moments), np.full(width, 1 / width, dtype=np.float64), mode="valid"
    )
    return _spline(points, np.clip(resample, 0.0, places[-1]))[0]


def _parabolas(places: Floats, times: Floats, moments: Floats) -> Floats:
    inside = np.clip(moments, 0.0, times[-1])
    index = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, len(times) - 2)
    lasts = np.diff(times)
    speed = np.zeros(len(times))
    for at, (way, last) in enumerate(zip(np.diff(places), lasts, strict=True)):
        speed[at + 1] = max(0.0, 2 * way / last - speed[at])
    u = (inside - times[index]) / lasts[index]
    begin, end = speed[index], speed[index + 1]
    return np.asarray(places[index] + lasts[index] * u * (begin + u * (end - begin) / 2))


def _over(places: Floats, limits: Floats) -> list[float]:
    """How many times the limit velocity, acceleration and jerk come to."""
    over, slopes = [], places
    for limit in limits:
        slopes = np.diff(slopes, axis=0) / _STEP_S
        over.append(float(np.max(np.abs(slopes) / limit, initial=0.0)))
    return over
