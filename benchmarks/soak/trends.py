"""Trends of a series of samples: growth of memory and change of descriptors."""

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Final

import msgspec
import numpy as np

from benchmarks.reporting.report import percentile
from benchmarks.soak.processes import CHILDREN, PARTS, TOTAL, Sample

_Z_95: Final = 1.96
_POINTS: Final = 60
"""Largest number of medians per series: adjacent samples are not independent, so they are combined."""
_MIN_POINTS: Final = 4
_LOW_SHARE: Final = 0.1
_SUMS: Final = ("processes", "rss_mb", "pss_mb", "own_mb", "descriptors", "threads")


class Slope(msgspec.Struct, frozen=True):
    """Growth per hour [% of the median] with its 95 % confidence interval."""

    percent_per_h: float
    low: float
    high: float


class DescriptorTrend(msgspec.Struct, frozen=True, kw_only=True):
    """Descriptors of one part after warm-up; ``first`` and ``last`` are low percentiles of the first and last samples.

    Only samples with the most frequent number of the agent's children count, because each running script has its own
    descriptors, also at the agent. A leak raises the minimum.
    """

    part: str
    rss: Slope
    own: Slope
    rss_mb: float
    own_mb: float
    first_descriptors: float
    last_descriptors: float
    most_descriptors: int
    first_threads: float
    last_threads: float

    @property
    def more_descriptors(self) -> float:
        """Increase from the first to the last samples."""
        return self.last_descriptors - self.first_descriptors


def theil_sen(at_s: Sequence[float], values: Sequence[float]) -> Slope:
    """Returns the Theil-Sen slope (median of all pairwise slopes) and its confidence interval.

    The estimate is robust to outliers.

    Raises:
        ValueError: There are too few points.
    """
    count = len(at_s)
    if count < _MIN_POINTS:
        raise ValueError(f"{count} points are too few for a slope")
    times, measured = np.asarray(at_s), np.asarray(values)
    first, second = np.triu_indices(count, 1)
    pairs = (measured[second] - measured[first]) / (times[second] - times[first])
    pairs.sort()
    spread = _Z_95 * math.sqrt(count * (count - 1) * (2 * count + 5) / 18)
    low = max(0, round((len(pairs) - spread) / 2) - 1)
    high = min(len(pairs) - 1, round((len(pairs) + spread) / 2))
    to_percent = 3600 * 100 / float(np.median(measured))
    return Slope(*(float(each) * to_percent for each in (np.median(pairs), pairs[low], pairs[high])))


def reduced_to_medians(at_s: Sequence[float], values: Sequence[float]) -> tuple[list[float], list[float]]:
    """Returns medians of intervals of equal length."""
    size = max(1, math.ceil(len(at_s) / _POINTS))
    intervals = [slice(begin, begin + size) for begin in range(0, len(at_s), size)]
    return [statistics.median(at_s[each]) for each in intervals], [
        statistics.median(values[each]) for each in intervals
    ]


def after_warm_up(samples: Iterable[Sample], warm_up_s: float, *, end_share: float = 0.1) -> list[DescriptorTrend]:
    """Returns the values of each part and their total. ``end_share``: share of samples used at both ends."""
    samples = list(samples)
    samples += totals(samples)
    comparable = _at_equal_load(each for each in samples if each.at_s >= warm_up_s)
    found = []
    for part in (*PARTS, TOTAL):
        mine = [each for each in samples if each.part == part and each.at_s >= warm_up_s]
        if len(mine) < _MIN_POINTS:
            continue
        at_s = [each.at_s for each in mine]
        equal = [each for each in mine if each.at_s in comparable] or mine  # most often there may be no children
        few = max(1, round(len(equal) * end_share))

        def ends(values: list[int], few: int = few) -> tuple[float, float]:
            return percentile(values[:few], _LOW_SHARE), percentile(values[-few:], _LOW_SHARE)

        rss, own = [each.rss_mb for each in mine], [each.own_mb for each in mine]
        descriptors, threads = [each.descriptors for each in equal], [each.threads for each in equal]
        found.append(
            DescriptorTrend(
                part=part,
                rss=theil_sen(*reduced_to_medians(at_s, rss)),
                own=theil_sen(*reduced_to_medians(at_s, own)),
                rss_mb=percentile(rss, 0.5),
                own_mb=percentile(own, 0.5),
                first_descriptors=ends(descriptors)[0],
                last_descriptors=ends(descriptors)[1],
                most_descriptors=max(each.descriptors for each in mine),
                first_threads=ends(threads)[0],
                last_threads=ends(threads)[1],
            )
        )
    return found


def _at_equal_load(samples: Iterable[Sample]) -> set[float]:
    """Returns the times of the samplings with the most frequent number of the agent's children."""
    children: dict[float, int] = {}
    for each in samples:
        children[each.at_s] = children.get(each.at_s, 0) + (each.processes if each.part == CHILDREN else 0)
    most_frequent = statistics.mode(children.values()) if children else 0
    return {at_s for at_s, number in children.items() if number == most_frequent}


def totals(samples: Iterable[Sample]) -> list[Sample]:
    """Returns the totals of each sampling; the number of the agent's children varies."""
    samplings: dict[float, list[Sample]] = {}
    for each in samples:
        if each.part != CHILDREN:
            samplings.setdefault(each.at_s, []).append(each)
    return [
        Sample(at_s=at_s, part=TOTAL, **{name: sum(getattr(each, name) for each in found) for name in _SUMS})
        for at_s, found in samplings.items()
    ]
