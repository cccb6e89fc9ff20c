"""Time until a field reaches a limit, as a 90 % prediction interval from short and long windows.

Each window is a line through its values. A line is used only if its two halves agree, apart from a slowing rise. The
earliest time follows from the steepest slope that the noise permits. The latest time follows from the flattest slope,
which also keeps slowing as the observed one may do. Without a bounded interval there is no forecast.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

Point = tuple[float, float]
"""Time relative to the forecast [s], and value."""

SHORT = (4, 6, 12)
"""Numbers of ten-second means in the short windows."""
LONG = (6, 10, 20)
"""Numbers of one-minute means in the long windows."""
_QUANTILE = (0.0, 6.31, 2.92, 2.35, 2.13, 2.02, 1.94, 1.89, 1.86, 1.83, 1.81)
"""95 % quantile of Student's t distribution by degrees of freedom; 1.7 for more."""
_EVEN = 0.35
"""The smallest of the increments of the shortest window is at least this share of their median: a step is no trend."""
_RESOLUTION_S = 10.0
"""Shortest interval: values are means over ten seconds [s]."""
_EARLIER = 0.93
"""Factor of the earliest time, for rises that become faster."""
_STEADY = 0.15
"""A slope may decrease by this share from one half of its window to the other and still count as constant."""
_WIDEST, _SLACK_S = 4.0, 200.0
"""The latest time is at most this multiple of the earliest one, or this much later [s]."""


@dataclass(frozen=True, slots=True)
class Interval:
    """The limit is reached between these times from now [s], with a probability of 90 %."""

    earliest_s: float
    latest_s: float


def forecast(
    recent: Sequence[Point], minutes: Sequence[Point], *, low: float | None, high: float | None
) -> Interval | None:
    """The interval of the longest window that follows a line; ``None``: uncertain, or no limit is approached.

    Args:
        recent: Newest ten-second means, oldest first.
        minutes: Newest one-minute means, oldest first.
        low: Lower limit.
        high: Upper limit.
    """
    windows = [minutes[-count:] for count in reversed(LONG) if len(minutes) >= count]
    windows += [recent[-count:] for count in reversed(SHORT) if len(recent) >= count]
    for points in windows:
        line = _Line(points, noise=_noise(recent if points[-1] == recent[-1] else minutes))
        if line.is_steady and line.continues_to(recent):
            limit = high if line.slope > 0 else low
            return None if limit is None else line.time_to(limit, recent)
    return None


def _noise(points: Sequence[Point]) -> float:
    """Standard deviation of single values, from second differences: a line or a single bend does not change it."""
    bends = []
    for (t0, y0), (t1, y1), (t2, y2) in zip(points, points[1:], points[2:], strict=False):
        share = (t1 - t0) / (t2 - t0)
        expected = y0 + share * (y2 - y0)
        bends.append(abs(y1 - expected) / math.sqrt(1 + share * share + (1 - share) * (1 - share)))
    return 1.4826 * median(bends) if bends else 0.0


class _Line:
    """Least-squares line through points; times end near zero."""

    def __init__(self, points: Sequence[Point], *, noise: float) -> None:
        self._points = points
        count = len(points)
        half = count // 2
        self.slope, self._mean, self._center_s, spread = _fit(points)
        rests = [y - self._mean - self.slope * (t - self._center_s) for t, y in points]
        self._freedom = count - 2
        self._residual = math.sqrt(sum(rest * rest for rest in rests) / self._freedom)
        self._noise = max(noise, 1e-9 * abs(self._mean))
        self._scale = max(self._residual, self._noise)
        quantile = _QUANTILE[self._freedom] if self._freedom < len(_QUANTILE) else 1.7
        self._error = quantile * self._scale / math.sqrt(spread)
        self._end_error = quantile * self._scale / math.sqrt(count)
        self._older, _, older_s, older_spread = _fit(points[:half])
        self._newer, self._newer_mean, self._newer_s, newer_spread = _fit(points[-half:])
        self._middle = _fit(points[half // 2 : half // 2 + half])[0]
        self._apart_s = self._newer_s - older_s
        # The noise of the halves is common to both, so the quantile of a normal distribution applies.
        self._half_error = 1.7 * self._noise * math.sqrt(1 / older_spread + 1 / newer_spread)

    @property
    def is_steady(self) -> bool:
        """Whether the slope is significant and the same in both halves, or slowly decaying."""
        if abs(self.slope) <= 2 * self._error:
            return False
        direction = math.copysign(1.0, self.slope)
        if len(self._points) == SHORT[0]:
            steps = [direction * (y1 - y0) / (t1 - t0) for (t0, y0), (t1, y1) in pairwise(self._points)]
            return min(steps) >= _EVEN * median(steps)
        older, newer = direction * self._older, direction * self._newer
        return 0.5 * older - self._half_error <= newer <= 1.05 * older + self._half_error and newer > 0

    def continues_to(self, recent: Sequence[Point]) -> bool:
        """Whether the newest values are on the line: the trend has neither ended nor become faster."""
        if self._points[-1] == recent[-1]:
            return True
        rests = [y - self._mean - self.slope * (t - self._center_s) for t, y in recent[-SHORT[0] :]]
        allowed = 2 * _noise(recent) + self._end_error * 2 + abs(self.slope) * self._apart_s * 0.1
        return abs(median(rests)) <= allowed

    def time_to(self, limit: float, recent: Sequence[Point]) -> Interval | None:
        """The interval in which the value reaches the limit, which the slope approaches."""
        direction = math.copysign(1.0, self.slope)
        if direction * (limit - recent[-1][1]) <= 0:
            return Interval(0.0, 0.0)
        # Three estimates of the present value: the ends of the line, of its newer half, and of the newest values.
        _, newest, newest_s, _ = _fit(recent[-SHORT[0] :])
        ends = (
            self._mean - self.slope * self._center_s,
            self._newer_mean - self._newer * self._newer_s,
            newest - self._newer * newest_s,
        )
        near = max(0.0, min(direction * (limit - end) for end in ends) - self._end_error)
        far = max(near, max(direction * (limit - end) for end in ends) + self._end_error)
        newer, middle = direction * self._newer, direction * self._middle
        # The first increment of the shortest window may be a part of one.
        older = max(direction * self._older, direction * self.slope, middle)
        steepest = max(direction * self.slope, newer, middle) + self._error
        flattest = min(direction * self.slope, newer) - self._error
        slowing = _STEADY + max(0.0, older - newer + self._half_error) / older
        decay_per_s = -math.log1p(-min(slowing, 0.95)) / self._apart_s
        flattest *= math.exp(decay_per_s * self._newer_s)  # from the middle of the newer half until now
        if flattest <= 0 or decay_per_s * far >= flattest:
            return None
        latest_s = -math.log1p(-decay_per_s * far / flattest) / decay_per_s
        earliest_s = _EARLIER * near / steepest
        if latest_s > max(_WIDEST * earliest_s, earliest_s + _SLACK_S):
            return None
        return Interval(earliest_s, max(latest_s, earliest_s + _RESOLUTION_S))


def _fit(points: Sequence[Point]) -> tuple[float, float, float, float]:
    """Slope, mean, mean time [s] and sum of squared time distances [s²]."""
    count = len(points)
    center_s = sum(t for t, _ in points) / count
    mean = sum(y for _, y in points) / count
    spread = sum((t - center_s) ** 2 for t, _ in points)
    slope = sum((t - center_s) * (y - mean) for t, y in points) / spread
    return slope, mean, center_s, spread
