"""Time series: samples in windows of 10 s, and aggregates in coarser buckets.

Samples are stored by column, because a robot sends a million values per hour.
"""

import base64
import math
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

WINDOW_MS = 10_000
MAX_VALUES = 22_000
"""Maximum number of values and times in a window, so that a row stays below 256 KB even if incompressible."""
MAX_FIELDS = 256
"""Maximum number of fields of a sample."""
MAX_MAGNITUDE = 1e300
"""Largest value: sums over a century of such values stay finite."""
_COMPRESSION = 1
_BYTES = 8
_NAN = math.nan


class Level(NamedTuple):
    """A bucket length. Row keys start with ``name``."""

    name: str
    span_ms: int


RAW = Level("raw", 0)
FINEST = Level("10s", WINDOW_MS)
LEVELS = (
    FINEST,
    Level("1min", 60_000),
    Level("10min", 600_000),
    Level("1h", 3_600_000),
    Level("6h", 21_600_000),
    Level("1d", 86_400_000),
)
DAY = LEVELS[-1]


@dataclass(slots=True)
class Samples:
    """Samples of one stream in ascending order of unique times; NaN marks a missing field."""

    at_ms: "array[int]" = field(default_factory=lambda: array("q"))
    columns: "dict[str, array[float]]" = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.at_ms)

    def part(self, start: int, end: int) -> "Samples":
        """Samples from index ``start`` up to, but not including, ``end``."""
        return Samples(self.at_ms[start:end], {name: values[start:end] for name, values in self.columns.items()})

    def chosen(self, indices: Sequence[int]) -> "Samples":
        """Samples with these indices, in ascending order."""
        if len(indices) == len(self):
            return self
        return Samples(
            array("q", [self.at_ms[index] for index in indices]),
            {name: array("d", [values[index] for index in indices]) for name, values in self.columns.items()},
        )

    def between(self, first_ms: int, last_ms: int) -> "Samples":
        """Samples with ``first_ms`` ≤ time < ``last_ms``."""
        return self.part(bisect_left(self.at_ms, first_ms), bisect_left(self.at_ms, last_ms))

    def windows(self) -> Iterator[tuple[int, "Samples"]]:
        """Start of each window, and its samples."""
        begin, count = 0, len(self.at_ms)
        while begin < count:
            start_ms = floor(self.at_ms[begin], WINDOW_MS)
            end = bisect_left(self.at_ms, start_ms + WINDOW_MS, begin)
            yield start_ms, self.part(begin, end)
            begin = end


def from_rows(rows: Iterable[tuple[int, Mapping[str, float]]]) -> Samples:
    """Samples from rows in any order; the first of two rows with the same time is used."""
    by_time: dict[int, Mapping[str, float]] = {}
    for at_ms, values in rows:
        by_time.setdefault(at_ms, values)
    ordered = sorted(by_time)
    names = dict.fromkeys(name for at_ms in ordered for name in by_time[at_ms])
    columns = {name: array("d", [by_time[at_ms].get(name, _NAN) for at_ms in ordered]) for name in names}
    return Samples(array("q", ordered), columns)


def new_samples(samples: Samples, existing: Samples) -> Samples:
    """Samples whose time is not in ``existing``."""
    if not existing.at_ms or not samples.at_ms or samples.at_ms[0] > existing.at_ms[-1]:
        return samples
    times = set(existing.at_ms)
    return samples.chosen([index for index, at_ms in enumerate(samples.at_ms) if at_ms not in times])


def merge(one: Samples, other: Samples) -> Samples:
    """Both sets of samples, which have no time in common."""
    if not one.at_ms or not other.at_ms:
        return other if not one.at_ms else one
    if one.at_ms[0] > other.at_ms[0]:
        one, other = other, one
    merged = Samples(one.at_ms + other.at_ms)
    for name in dict.fromkeys((*one.columns, *other.columns)):
        left, right = (each.columns.get(name) or _missing(len(each)) for each in (one, other))
        merged.columns[name] = left + right
    if one.at_ms[-1] > other.at_ms[0]:
        order = sorted(range(len(merged)), key=merged.at_ms.__getitem__)
        merged.at_ms = array("q", [merged.at_ms[index] for index in order])
        merged.columns = {name: array("d", [values[i] for i in order]) for name, values in merged.columns.items()}
    return merged


def fit_window(samples: Samples, existing: Samples) -> Samples:
    """The samples to store of those of one window, so that all of the window is covered.

    A tenth of what a window may contain is free for any time. The rest becomes available evenly over the window, so
    samples at a higher rate are thinned out instead of cut off.
    """
    most = MAX_VALUES // (len({*samples.columns, *existing.columns}) + 1)
    burst = most // 10
    chosen: list[int] = []
    for index, at_ms in enumerate(samples.at_ms):
        allowed = burst + math.ceil((most - burst) * (at_ms % WINDOW_MS + 1) / WINDOW_MS)
        before = bisect_left(existing.at_ms, at_ms) + len(chosen)
        if before < allowed and len(existing) + len(chosen) < most:
            chosen.append(index)
    return samples.chosen(chosen)


# ---------------------------------------------------------------- rows


def floor(at_ms: int, span_ms: int) -> int:
    """Start of the bucket that contains a time."""
    return at_ms - at_ms % span_ms


def key(level: Level, start_ms: int) -> str:
    """Row key; the keys of one level sort by time."""
    return f"{level.name}:{start_ms:013d}"


def start_of(row_key: str) -> int:
    """Start time in a row key."""
    return int(row_key.partition(":")[2])


def pack(samples: Samples) -> dict[str, Any]:
    """Samples as JSON: compressed columns of binary numbers."""
    base_ms = samples.at_ms[0] if samples.at_ms else 0
    offsets = array("q", [at_ms - base_ms for at_ms in samples.at_ms])
    data = b"".join((offsets.tobytes(), *(values.tobytes() for values in samples.columns.values())))
    # Group the bytes of equal significance: the slowly changing ones compress better.
    planes = b"".join(data[plane::_BYTES] for plane in range(_BYTES))
    text = base64.b64encode(zlib.compress(planes, _COMPRESSION)).decode()
    return {"base_ms": base_ms, "count": len(samples), "fields": list(samples.columns), "data": text}


def unpack(data: Mapping[str, Any]) -> Samples:
    """The samples from the result of ``pack``."""
    planes = zlib.decompress(base64.b64decode(data["data"]))
    length = len(planes) // _BYTES
    content = bytearray(len(planes))
    for plane in range(_BYTES):
        content[plane::_BYTES] = planes[plane * length : (plane + 1) * length]
    size = data["count"] * _BYTES
    base_ms = data["base_ms"]
    samples = Samples(array("q", [base_ms + offset for offset in array("q", bytes(content[:size]))]))
    for index, name in enumerate(data["fields"], 1):
        samples.columns[name] = array("d", bytes(content[index * size : (index + 1) * size]))
    return samples


# ---------------------------------------------------------------- buckets


class Summary(NamedTuple):
    """Aggregate of one field; ``last`` is the value with the latest time."""

    samples: int
    total: float
    low: float
    high: float
    last: float
    last_ms: int

    @property
    def mean(self) -> float:
        """Arithmetic mean."""
        return self.total / self.samples


@dataclass(slots=True)
class Bucket:
    """Aggregate of the samples in a time span."""

    count: int = 0
    fields: dict[str, Summary] = field(default_factory=dict)

    def add(self, other: "Bucket") -> None:
        """Merge another aggregate."""
        self.count += other.count
        fields = self.fields
        for name, new in other.fields.items():
            old = fields.get(name)
            fields[name] = new if old is None else _merged(old, new)

    def data(self) -> dict[str, Any]:
        """The row data."""
        return {"count": self.count, "fields": self.fields}


def bucket(data: Mapping[str, Any]) -> Bucket:
    """The bucket from row data."""
    return Bucket(data["count"], {name: Summary(*values) for name, values in data["fields"].items()})


def summarize(samples: Samples) -> Bucket:
    """The aggregate of samples."""
    times = samples.at_ms
    result = Bucket(len(times))
    for name, values in samples.columns.items():
        total = sum(values)
        if total == total:  # noqa: PLR0124 (no NaN among them)
            result.fields[name] = Summary(len(values), total, min(values), max(values), values[-1], times[-1])
            continue
        present = [index for index, value in enumerate(values) if not math.isnan(value)]
        if present:
            some = [values[index] for index in present]
            result.fields[name] = Summary(len(some), sum(some), min(some), max(some), some[-1], times[present[-1]])
    return result


def _merged(one: Summary, other: Summary) -> Summary:
    last = one if one.last_ms > other.last_ms else other
    return Summary(
        one.samples + other.samples,
        one.total + other.total,
        min(one.low, other.low),
        max(one.high, other.high),
        last.last,
        last.last_ms,
    )


def _missing(count: int) -> "array[float]":
    return array("d", [_NAN]) * count


# ---------------------------------------------------------------- retention and resolution


@dataclass(frozen=True, slots=True, kw_only=True)
class RetentionPolicy:
    """How long rows are stored [ms]; levels without an entry are stored without limit.

    The raw row records which times are stored. After its deletion duplicates cannot be detected, so older samples are
    rejected.
    """

    raw_ms: int = 24 * 3_600_000
    levels_ms: Mapping[str, int] = field(
        default_factory=lambda: {"10s": 7 * DAY.span_ms, "1min": 90 * DAY.span_ms, "10min": 730 * DAY.span_ms}
    )

    def of(self, level: Level) -> int | None:
        """Minimum time that rows of a level are stored after the end of their day; ``None``: without limit."""
        if level == RAW:
            return self.raw_ms
        retention_ms = self.levels_ms.get(level.name)
        return None if retention_ms is None else max(retention_ms, self.raw_ms)


def finest_level(first_ms: int, last_ms: int, *, points: int, now_ms: int, keep: RetentionPolicy) -> Level:
    """The finest level with at most ``points`` buckets in the time span, whose rows still exist."""
    for level in LEVELS:
        covering = (floor(last_ms - 1, level.span_ms) - floor(first_ms, level.span_ms)) // level.span_ms + 1
        retention_ms = keep.of(level)
        if covering <= points and (
            retention_ms is None or floor(first_ms, DAY.span_ms) + DAY.span_ms + retention_ms > now_ms
        ):
            return level
    return LEVELS[-1]
