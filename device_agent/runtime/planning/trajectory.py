"""Joint-space trajectories: corner blending, resampling and time parameterization."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from device_agent.protocol import Joint

Floats = npt.NDArray[np.float64]

_SPACINGS_RAD = (0.8, 0.5, 0.3, 0.2, 0.12, 0.08, 0.05, 0.03)
"""Spacings of the spline points that blend a corner, widest first; the first collision-free one is used [rad]."""
_CHECKS = 4
"""Collision checks in each span of the spline."""
_BATCH = 8
"""Segments that are checked together: few obstacles are near a short path."""
_GRID = 16
"""Points of each span for which a speed is computed."""
_CURVE_SHARE = 0.5
"""Share of acceleration and jerk for curvature; the rest is for changes of speed."""
_STEP_S = 0.001
_TOLERANCE = 1.005
_ITERATIONS = 10
_EPSILON = 1e-9
# A uniform cubic B-spline in one span: rows for 1, u, u², u³ of the share of the span, columns for its four points.
_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Positions, velocities and accelerations of all joints in a motion from rest to rest.

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
        """Duration at full speed [s]."""
        return (len(self.position_rad) - 1) * self.step_s

    def at(self, time_s: float) -> tuple[Floats, Floats, Floats]:
        """Position, velocity and acceleration, shape (n,) each, at a time that is clamped to the duration."""
        sample = min(max(time_s / self.step_s, 0.0), len(self.position_rad) - 1.0)
        index = min(int(sample), len(self.position_rad) - 2)
        u = sample - index
        start, end = self.position_rad[index : index + 2]
        rise, fall = self.velocity_rad_s[index : index + 2]
        delta, a, b = end - start, rise * self.step_s, fall * self.step_s
        position = start + u * (a + u * ((3 * delta - 2 * a - b) + u * (a + b - 2 * delta)))
        acceleration = (1 - u) * self.acceleration_rad_s2[index] + u * self.acceleration_rad_s2[index + 1]
        return position, rise + u * (fall - rise), acceleration


def blend_corners(corners: Sequence[Sequence[float]], is_clear: Callable[[Floats], bool]) -> Floats | None:
    """The points of a spline along a path, with corners blended as widely as obstacles allow.

    Args:
        corners: At least two positions, shape (n,) [rad] each.
        is_clear: Whether positions, shape (k, n), and the straight segments between them are collision-free.

    Returns:
        The points, shape (points, n); ``None`` if not even the narrowest blend is collision-free.
    """
    path = np.array(corners, dtype=np.float64)
    for spacing_rad in _SPACINGS_RAD:
        points = resample(path, spacing_rad)
        positions = _along(points, _CHECKS)[0]
        if all(is_clear(positions[index : index + _BATCH + 1]) for index in range(0, len(positions) - 1, _BATCH)):
            return points
    return None


def resample(path: Floats, spacing_rad: float) -> Floats:
    """Equally spaced points on a path, at most ``spacing_rad`` apart.

    A spline through unequally spaced points would have an uneven speed.
    """
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))
    count = max(1, int(np.ceil(lengths[-1] / spacing_rad)))
    distances = np.linspace(0.0, lengths[-1], count + 1)
    points: Floats = np.stack([np.interp(distances, lengths, joint) for joint in path.T], axis=1)
    points[0], points[-1] = path[0], path[-1]
    return points


def time_parameterize(points: Floats, joints: Sequence[Joint], *, speed: float, step_s: float) -> Trajectory:
    """The fastest trajectory along a spline within each joint's velocity, acceleration and jerk limits.

    The speed is the highest that the curvature allows. The remaining acceleration limits its changes, and a moving
    average over the jerk's ramp time smooths it.

    Args:
        points: Points of the spline, shape (points, n) [rad].
        joints: Joints with their limits.
        speed: Share of each joint's velocity limit, above 0 and at most 1.
        step_s: Time between two samples of the trajectory [s].
    """
    limits = np.array(
        [(joint.max_velocity_rad_s * speed, joint.max_acceleration_rad_s2, joint.max_jerk_rad_s3) for joint in joints]
    ).T
    ramp_s = float(np.max(limits[1] / limits[2]))
    allowed = limits.copy()
    for _ in range(_ITERATIONS):
        positions = _sample(points, _time_law(points, allowed), ramp_s)
        velocity_excess, acceleration_excess, jerk_excess = _excess(positions, limits)
        excess = max(velocity_excess, acceleration_excess**0.5)
        if max(excess, jerk_excess) <= _TOLERANCE:
            break
        if excess > _TOLERANCE:
            allowed /= np.array([[excess], [excess**2], [excess**3]])
        ramp_s *= max(1.0, jerk_excess)
    every = max(1, round(step_s / _STEP_S))
    positions = np.concatenate((positions, np.repeat(positions[-1:], -(len(positions) - 1) % every, axis=0)))
    velocity = np.gradient(positions, _STEP_S, axis=0)
    acceleration = np.gradient(velocity, _STEP_S, axis=0)
    velocity[[0, -1]] = acceleration[[0, -1]] = 0.0
    return Trajectory(every * _STEP_S, positions[::every], velocity[::every], acceleration[::every])


def _along(points: Floats, parts: int) -> tuple[Floats, Floats, Floats, Floats]:
    """The spline and its first three derivatives at ``parts`` points per span, shape (points, n) each."""
    spans = len(points) - 1
    return _spline(points, np.linspace(0.0, spans, spans * parts + 1))


def _spline(points: Floats, parameters: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    # Mirrored ends: the spline starts and ends at its first and last point.
    whole = np.concatenate(([2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]))
    index = np.minimum(parameters.astype(np.intp), len(points) - 2)
    u = (parameters - index)[:, np.newaxis]
    near = whole[index[:, np.newaxis] + np.arange(4)]
    one, two, three, four = (np.einsum("c,pcn->pn", row, near) for row in _SPLINE)
    return (
        one + u * (two + u * (three + u * four)),
        two + u * (2 * three + 3 * u * four),
        2 * three + 6 * u * four,
        6 * four,
    )


def _time_law(points: Floats, limits: Floats) -> tuple[Floats, Floats]:
    """Spline parameters and the times at which to reach them [s], within the acceleration limit."""
    _, first, second, third = (np.abs(part) + _EPSILON for part in _along(points, _GRID))
    velocity, acceleration, jerk = limits
    curve_speed = np.minimum(np.sqrt(_CURVE_SHARE * acceleration / second), np.cbrt(_CURVE_SHARE * jerk / third))
    fastest = np.min(np.minimum(velocity / first, curve_speed), axis=1)
    gain = np.min((acceleration - second * fastest[:, np.newaxis] ** 2) / first, axis=1)
    square = fastest**2
    square[[0, -1]] = 0.0
    for order in (range(1, len(square)), range(len(square) - 2, -1, -1)):
        step = order.step
        for index in order:
            square[index] = min(square[index], square[index - step] + 2 * gain[index - step] / _GRID)
    speed = np.sqrt(square)
    return np.arange(len(square)) / _GRID, np.concatenate(([0.0], np.cumsum(2 / _GRID / (speed[1:] + speed[:-1]))))


def _sample(points: Floats, time_law: tuple[Floats, Floats], ramp_s: float) -> Floats:
    """Positions every ``_STEP_S``, with accelerations that build up over ``ramp_s``, shape (samples, n)."""
    parameters, times = time_law
    width = max(1, round(ramp_s / _STEP_S))
    sample_times: Floats = np.arange(-width, int(times[-1] / _STEP_S) + 2 * width, dtype=np.float64) * _STEP_S
    # Between two parameters the acceleration is constant, so the parameter is a parabola of time.
    smoothed = np.convolve(
        _parabolas(parameters, times, sample_times), np.full(width, 1 / width, dtype=np.float64), mode="valid"
    )
    return _spline(points, np.clip(smoothed, 0.0, parameters[-1]))[0]


def _parabolas(parameters: Floats, times: Floats, sample_times: Floats) -> Floats:
    inside = np.clip(sample_times, 0.0, times[-1])
    index = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, len(times) - 2)
    durations = np.diff(times)
    speed = np.zeros(len(times))
    for segment, (delta, duration) in enumerate(zip(np.diff(parameters), durations, strict=True)):
        speed[segment + 1] = max(0.0, 2 * delta / duration - speed[segment])
    u = (inside - times[index]) / durations[index]
    start, end = speed[index], speed[index + 1]
    return np.asarray(parameters[index] + durations[index] * u * (start + u * (end - start) / 2))


def _excess(positions: Floats, limits: Floats) -> list[float]:
    """Ratios of velocity, acceleration and jerk to their limits."""
    excess, slopes = [], positions
    for limit in limits:
        slopes = np.diff(slopes, axis=0) / _STEP_S
        excess.append(float(np.max(np.abs(slopes) / limit, initial=0.0)))
    return excess
