"""Mergeable latency histograms with quantiles of bounded relative error.

The buckets follow DDSketch (Masson, Rim, Lee: "DDSketch", VLDB 2019): powers of ``GAMMA``, so every value is within
``ERROR`` of its bucket. Only counts are stored, so merging is addition. The ``ddsketch`` library stores its own
objects as protobuf; rows need plain numbers.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

ERROR = 0.01
"""Relative error of a quantile: 1 %."""
GAMMA = (1 + ERROR) / (1 - ERROR)
SHORTEST_MS = 0.001
"""Shorter times are clipped to this [ms]."""
LONGEST_MS = 86_400_000.0
"""Longest accepted time: one day [ms]."""

_LOG_GAMMA = math.log(GAMMA)


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of times [ms].

    Attributes:
        buckets: Numbers of the non-empty buckets, ascending.
        counts: Count of each of these buckets.
    """

    count: int = 0
    sum_ms: float = 0.0
    min_ms: float = 0.0
    max_ms: float = 0.0
    buckets: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()

    @property
    def mean_ms(self) -> float:
        """The exact mean [ms]."""
        return self.sum_ms / self.count if self.count else 0.0

    def quantile(self, share: float) -> float:
        """The time that ``share`` (0…1) of the samples do not exceed: rank ⌈share·count⌉, within 1 % [ms].

        Raises:
            ValueError: There are no samples.
        """
        if not self.count:
            raise ValueError("no samples, no quantile")
        rank = max(1, math.ceil(share * self.count))
        if rank == self.count:
            return self.max_ms
        total = 0
        for bucket, count in zip(self.buckets, self.counts, strict=True):
            total += count
            if total >= rank:
                return min(self.max_ms, max(self.min_ms, _middle_ms(bucket)))
        return self.max_ms

    def bins(self) -> list[tuple[float, float, int]]:
        """Lower bound, upper bound [ms] and count of each non-empty bucket."""
        return [
            (GAMMA ** (bucket - 1), GAMMA**bucket, count)
            for bucket, count in zip(self.buckets, self.counts, strict=True)
        ]


def of(samples_ms: Iterable[float]) -> Histogram:
    """The histogram of samples [ms].

    Raises:
        ValueError: A sample is negative, longer than a day, or not a number.
    """
    result: dict[int, int] = {}
    values = list(samples_ms)
    for value in values:
        if not 0 <= value <= LONGEST_MS:
            raise ValueError(f"a time is 0 to {LONGEST_MS:.0f} ms, not {value}")
        bucket = _bucket(value)
        result[bucket] = result.get(bucket, 0) + 1
    if not values:
        return Histogram()
    buckets = tuple(sorted(result))
    counts = tuple(result[bucket] for bucket in buckets)
    return Histogram(len(values), math.fsum(values), min(values), max(values), buckets, counts)


def merge(histograms: Iterable[Histogram]) -> Histogram:
    """The histogram of all samples of the given histograms."""
    parts = [part for part in histograms if part.count]
    if not parts:
        return Histogram()
    result: dict[int, int] = {}
    for part in parts:
        for bucket, count in zip(part.buckets, part.counts, strict=True):
            result[bucket] = result.get(bucket, 0) + count
    buckets = tuple(sorted(result))
    return Histogram(
        count=sum(part.count for part in parts),
        sum_ms=math.fsum(part.sum_ms for part in parts),
        min_ms=min(part.min_ms for part in parts),
        max_ms=max(part.max_ms for part in parts),
        buckets=buckets,
        counts=tuple(result[bucket] for bucket in buckets),
    )


def _bucket(value_ms: float) -> int:
    """``GAMMA**(b-1) < value ≤ GAMMA**b``."""
    return math.ceil(math.log(max(value_ms, SHORTEST_MS)) / _LOG_GAMMA)


def _middle_ms(bucket: int) -> float:
    """The value with equal relative distance to both bounds of the bucket."""
    return float(2 * GAMMA**bucket / (GAMMA + 1))
