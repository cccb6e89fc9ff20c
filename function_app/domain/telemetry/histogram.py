"""Histograms of times that can be merged, with quantiles of a promised relative error.

The buckets are those of DDSketch (Masson, Rim, Lee: "DDSketch", VLDB 2019): powers of ``GAMMA``, so that every value
in one is within ``ERROR`` of the bucket's own. Nothing is kept but counts: the histogram of two sets of samples is the
sum of theirs, in any order. The library of that name keeps its counts in objects of its own and writes them with
protobuf; a row wants plain numbers, and then these few lines are all that is left of it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

ERROR = 0.01
"""Relative error of a quantile: 1 %."""
GAMMA = (1 + ERROR) / (1 - ERROR)
SHORTEST_MS = 0.001
"""Shorter times count as this."""
LONGEST_MS = 86_400_000.0
"""Nothing takes longer than a day."""

_LOG_GAMMA = math.log(GAMMA)


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of times [ms].

    Attributes:
        buckets: Numbers of the buckets that hold something, rising.
        counts: How many each of them holds.
    """

    count: int = 0
    sum_ms: float = 0.0
    min_ms: float = 0.0
    max_ms: float = 0.0
    buckets: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()

    @property
    def mean_ms(self) -> float:
        """The mean, without the buckets' error."""
        return self.sum_ms / self.count if self.count else 0.0

    def quantile(self, share: float) -> float:
        """The time that ``share`` (0…1) of the samples do not exceed: the one of rank ⌈share·count⌉, within 1 %.

        Raises:
            ValueError: There are no samples.
        """
        if not self.count:
            raise ValueError("no samples, no quantile")
        rank = max(1, math.ceil(share * self.count))
        if rank == self.count:
            return self.max_ms
        seen = 0
        for bucket, count in zip(self.buckets, self.counts, strict=True):
            seen += count
            if seen >= rank:
                return min(self.max_ms, max(self.min_ms, _middle_ms(bucket)))
        return self.max_ms

    def bins(self) -> list[tuple[float, float, int]]:
        """Lower bound, upper bound [ms] and count of each bucket that holds something."""
        return [
            (GAMMA ** (bucket - 1), GAMMA**bucket, count)
            for bucket, count in zip(self.buckets, self.counts, strict=True)
        ]


def of(samples_ms: Iterable[float]) -> Histogram:
    """The histogram of some times [ms].

    Raises:
        ValueError: One is negative, longer than a day, or no number.
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
    """The histogram of all their samples together."""
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
    """The value whose relative distance to both ends of the bucket is the same."""
    return float(2 * GAMMA**bucket / (GAMMA + 1))
