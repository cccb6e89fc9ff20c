"""Estimators for change, baseline, slope and hysteresis, each with a state of a few numbers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import median

WARM_UP = 60
"""Values before a detector triggers: ten minutes of 10 s values."""
VARIED = 30
"""Required number of values that differ from the previous one."""
MEMORY = 360
"""Memory of the baseline: one hour of 10 s values."""
DAY = 8_640
"""Values of ten seconds in a day."""
SETTLED = 30
"""Values before a change can be detected: five minutes."""


@dataclass(frozen=True, slots=True)
class PageHinkley:
    """Cumulative sums about a running mean, upwards and downwards.

    For up to one day of values this equals ``river.drift.PageHinkley`` with ``alpha=1``. The default ``alpha`` of river
    decays the sums within 10,000 values, so daily warming would count as change. Here the mean covers one day instead.
    """

    count: int = 0
    mean: float = 0.0
    up: float = 0.0
    down: float = 0.0


def page_hinkley(previous: PageHinkley, value: float, *, delta: float, threshold: float) -> tuple[PageHinkley, bool]:
    """Add one value; return the new state and whether the mean has changed. After a change start with an empty state.

    Shifts below ``delta`` are ignored; ``threshold`` limits the cumulative sum beyond it.
    """
    count = min(previous.count + 1, DAY)
    mean = previous.mean + (value - previous.mean) / count
    up = max(0.0, previous.up + value - mean - delta)
    down = max(0.0, previous.down + mean - value - delta)
    return PageHinkley(count, mean, up, down), count >= SETTLED and max(up, down) > threshold


@dataclass(frozen=True, slots=True)
class Baseline:
    """Exponentially weighted mean and mean absolute deviation, robust against single outliers.

    ``count`` is the number of values in the mean (at most ``MEMORY``); ``varied`` counts those that differ from their
    predecessor, which are in the deviation.
    """

    count: int = 0
    mean: float = 0.0
    varied: int = 0
    distance: float = 0.0

    @property
    def noise(self) -> float:
        """Standard deviation derived from the mean deviation of a normal distribution."""
        return self.distance * math.sqrt(math.pi / 2)


CLIP = 3.0
"""Values are clipped to this number of standard deviations."""


def learn(previous: Baseline, value: float, *, scale: float, repeated: bool) -> Baseline:
    """The baseline after one more value.

    ``scale`` is the lower bound of the standard deviation. ``repeated``: the value equals its predecessor; a stuck
    sensor must not reduce the noise estimate.
    """
    count = min(previous.count + 1, MEMORY)
    shift = value - previous.mean
    if previous.count >= WARM_UP:
        reach = CLIP * max(scale, previous.noise)
        # Without noise there is no scale for clipping.
        shift = max(-reach, min(reach, shift)) if reach > 0 else shift
    mean = previous.mean + shift / count
    if repeated or previous.count == 0:
        return Baseline(count, mean, previous.varied, previous.distance)
    varied = min(previous.varied + 1, MEMORY)
    return Baseline(count, mean, varied, previous.distance + (abs(shift) - previous.distance) / varied)


@dataclass(frozen=True, slots=True)
class Slope:
    """A line through the newest minutes.

    Attributes:
        per_s: Slope [unit/s].
        error_per_s: Standard error of the slope [unit/s].
        end: Value at the newest minute.
    """

    per_s: float
    error_per_s: float
    end: float


def theil_sen(values: Sequence[float], step_s: float) -> Slope:
    """Theil-Sen estimator: the median of all pairwise slopes tolerates 29 % outliers."""
    slopes = [(later - earlier) / (j - i) for (i, earlier), (j, later) in combinations(enumerate(values), 2)]
    per_step = median(slopes)
    rests = [value - per_step * place for place, value in enumerate(values)]
    middle = median(rests)
    noise = 1.4826 * median(abs(rest - middle) for rest in rests)
    count = len(values)
    error = noise * math.sqrt(12 / (count * (count * count - 1)))
    return Slope(per_step / step_s, error / step_s, middle + per_step * (count - 1))


@dataclass(frozen=True, slots=True)
class Streak:
    """Hysteresis: a state that changes after a number of equal observations."""

    on: bool = False
    length: int = 0
    """Number of consecutive observations of the other state."""

    def step(self, *, bad: bool, good: bool, after: int, until: int) -> "Streak":
        """Add one observation; neither good nor bad resets the count."""
        against = good if self.on else bad
        if not against:
            return Streak(self.on)
        length = self.length + 1
        return Streak(not self.on) if length >= (until if self.on else after) else Streak(self.on, length)
