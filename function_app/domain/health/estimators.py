"""What one number after another tells: a mean that has moved, what is usual, a slope, an answer that lasts.

Each is a few numbers that are kept between two values, and a function that gives the next few.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import median

WARM_UP = 60
"""Values before anything is called unusual: of ten seconds each, ten minutes;"""
VARIED = 30
"""and among them so many that show how it varies."""
MEMORY = 360
"""Values that the baseline remembers: it follows what lasts for an hour."""
DAY = 8_640
"""Values of ten seconds in a day."""
SETTLED = 30
"""Values before a change can be told: five minutes."""


@dataclass(frozen=True, slots=True)
class PageHinkley:
    """Page's cumulative sums about a running mean, one up and one down.

    Up to a day's values they are those of ``river.drift.PageHinkley`` with ``alpha=1``. Its own choice for ``alpha``
    forgets the sums, and with them ``delta``, within some 10,000 values: then every day's warmth is a change. Here the
    mean forgets instead, what is older than a day.
    """

    count: int = 0
    mean: float = 0.0
    up: float = 0.0
    down: float = 0.0


def page_hinkley(previous: PageHinkley, value: float, *, delta: float, threshold: float) -> tuple[PageHinkley, bool]:
    """One more value; and whether the mean has changed. The caller begins anew with an empty state then.

    Args:
        previous: The state so far.
        value: The value.
        delta: Shifts smaller than this are none.
        threshold: What the sum of shifts beyond ``delta`` may come to.
    """
    count = min(previous.count + 1, DAY)
    mean = previous.mean + (value - previous.mean) / count
    up = max(0.0, previous.up + value - mean - delta)
    down = max(0.0, previous.down + mean - value - delta)
    return PageHinkley(count, mean, up, down), count >= SETTLED and max(up, down) > threshold


@dataclass(frozen=True, slots=True)
class Baseline:
    """What is usual: a mean and a mean distance from it, each forgetting, none led astray by single values.

    Attributes:
        count: Values that the mean is of, at most ``MEMORY``.
        varied: Those among them that were not the one before again, which the distance is of.
    """

    count: int = 0
    mean: float = 0.0
    varied: int = 0
    distance: float = 0.0

    @property
    def noise(self) -> float:
        """Standard deviation, from the mean distance (of a normal distribution)."""
        return self.distance * math.sqrt(math.pi / 2)


CLIP = 3.0
"""Standard deviations beyond which a value counts as if it were so many."""


def learn(previous: Baseline, value: float, *, scale: float, repeated: bool) -> Baseline:
    """The baseline after one more value.

    Args:
        previous: The baseline before.
        value: The value.
        scale: What a standard deviation is taken to be at least.
        repeated: It is exactly the one before: a sensor that is stuck is no sensor without noise.
    """
    count = min(previous.count + 1, MEMORY)
    shift = value - previous.mean
    if previous.count >= WARM_UP:
        reach = CLIP * max(scale, previous.noise)
        # Without any noise there is nothing to clip by.
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
        per_s: Its slope [unit/s].
        error_per_s: The slope's standard error [unit/s].
        end: Its value at the newest minute.
    """

    per_s: float
    error_per_s: float
    end: float


def theil_sen(values: Sequence[float], step_s: float) -> Slope:
    """The median of the slopes of all pairs: a third of the values may be anything."""
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
    """Whether something is so, once it was so for long enough; and no longer, once it was not for long enough."""

    on: bool = False
    length: int = 0
    """How often in a row the answer was the other one."""

    def step(self, *, bad: bool, good: bool, after: int, until: int) -> "Streak":
        """One more answer; neither bad nor good leaves all as it is."""
        against = good if self.on else bad
        if not against:
            return Streak(self.on)
        length = self.length + 1
        return Streak(not self.on) if length >= (until if self.on else after) else Streak(self.on, length)
