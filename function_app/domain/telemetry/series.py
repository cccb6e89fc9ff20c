"""Measurements as time series: samples are a set by time, held in windows of 10 s and in coarser buckets.

What is worked through here comes in columns: a robot sends a million values in an hour, and each costs about as little
as Python's own loops over arrays do.
"""

import base64
import math
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

WINDOW_MS = 10_000
MAX_VALUES = 16_000
"""Values in one window: their row stays below 256 KB however badly they compress."""
MAX_FIELDS = 256
"""Fields of one sample."""
MAX_MAGNITUDE = 1e300
"""Sums of a century of such values are still finite."""
_COMPRESSION = 1
_BYTES = 8
_NAN = math.nan


class Level(NamedTuple):
    """Buckets of one length. ``name`` begins their keys."""

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
    """Samples of one stream by time, ascending, each time once; in a column NaN where a sample has no such field."""

    at_ms: "array[int]" = field(default_factory=lambda: array("q"))
    columns: "dict[str, array[float]]" = field(default_factory=dict)

    def __len__(self) -> int:
        """How many."""
        return len(self.at_ms)

    def part(self, start: int, end: int) -> "Samples":
        """Those from index ``start`` up to before ``end``."""
        return Samples(self.at_ms[start:end], {name: values[start:end] for name, values in self.columns.items()})

    def between(self, first_ms: int, last_ms: int) -> "Samples":
        """Those with ``first_ms`` ≤ time < ``last_ms``."""
        return self.part(bisect_left(self.at_ms, first_ms), bisect_left(self.at_ms, last_ms))

    def windows(self) -> Iterator[tuple[int, "Samples"]]:
        """Start of each window, and what is in it."""
        begin, count = 0, len(self.at_ms)
        while begin < count:
            start_ms = floor(self.at_ms[begin], WINDOW_MS)
            end = bisect_left(self.at_ms, start_ms + WINDOW_MS, begin)
            yield start_ms, self.part(begin, end)
            begin = end


def from_rows(rows: Iterable[tuple[int, Mapping[str, float]]]) -> Samples:
    """Samples from times and values in any order; of two at one time the first counts."""
    by_time: dict[int, Mapping[str, float]] = {}
    for at_ms, values in rows:
        by_time.setdefault(at_ms, values)
    ordered = sorted(by_time)
    names = dict.fromkeys(name for at_ms in ordered for name in by_time[at_ms])
    columns = {name: array("d", [by_time[at_ms].get(name, _NAN) for at_ms in ordered]) for name in names}
    return Samples(array("q", ordered), columns)


def new_samples(samples: Samples, existing: Samples) -> Samples:
    """Those whose time is not among the known."""
    if not existing.at_ms or not samples.at_ms or samples.at_ms[0] > existing.at_ms[-1]:
        return samples
    times = set(existing.at_ms)
    chosen = [index for index, at_ms in enumerate(samples.at_ms) if at_ms not in times]
    if len(chosen) == len(samples):
        return samples
    return Samples(
        array("q", [samples.at_ms[index] for index in chosen]),
        {name: array("d", [values[index] for index in chosen]) for name, values in samples.columns.items()},
    )


def merge(one: Samples, other: Samples) -> Samples:
    """Both. They have no time in common."""
    if not one.at_ms or not other.at_ms:
        return other if not one.at_ms else one
    if one.at_ms[0] > other.at_ms[0]:
        one, other = other, one
    merged = Samples(one.at_ms + other.at_ms)
    for name in dict.fromkeys((*one.columns, *other.columns)):
        left, right = (each.columns.get(name) or _nothing(len(each)) for each in (one, other))
        merged.columns[name] = left + right
    if one.at_ms[-1] > other.at_ms[0]:
        order = sorted(range(len(merged)), key=merged.at_ms.__getitem__)
        merged.at_ms = array("q", [merged.at_ms[index] for index in order])
        merged.columns = {name: array("d", [values[i] for i in order]) for name, values in merged.columns.items()}
    return merged


def fit_window(samples: Samples, existing: Samples) -> Samples:
    """As many of the samples as their window still takes."""
    names = len({*samples.columns, *existing.columns}) or 1
    left = max(0, MAX_VALUES // names - len(existing))
    return samples if len(samples) <= left else samples.part(0, left)


# ---------------------------------------------------------------- rows


def floor(at_ms: int, span_ms: int) -> int:
    """The start of the bucket in which a moment is."""
    return at_ms - at_ms % span_ms


def key(level: Level, start_ms: int) -> str:
    """The key of a row: those of one level sort by time."""
    return f"{level.name}:{start_ms:013d}"


def start_of(row_key: str) -> int:
    """The start in a row's key."""
    return int(row_key.partition(":")[2])


def pack(samples: Samples) -> dict[str, Any]:
    """Samples as JSON: columns of binary numbers, compressed."""
    base_ms = samples.at_ms[0] if samples.at_ms else 0
    offsets = array("q", [at_ms - base_ms for at_ms in samples.at_ms])
    data = b"".join((offsets.tobytes(), *(values.tobytes() for values in samples.columns.values())))
    # First all first bytes, then all second ones: what hardly changes compresses, and noise does not stand between.
    planes = b"".join(data[plane::_BYTES] for plane in range(_BYTES))
    text = base64.b64encode(zlib.compress(planes, _COMPRESSION)).decode()
    return {"base_ms": base_ms, "count": len(samples), "fields": list(samples.columns), "data": text}


def unpack(data: Mapping[str, Any]) -> Samples:
    """The samples that ``pack`` was given."""
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
    """What is left of the values of one field: the last one is that of the latest time, whenever it came."""

    samples: int
    total: float
    low: float
    high: float
    last: float
    last_ms: int

    @property
    def mean(self) -> float:
        """Their arithmetic mean."""
        return self.total / self.samples


@dataclass(slots=True)
class Bucket:
    """What is left of the samples of one stretch of time."""

    count: int = 0
    fields: dict[str, Summary] = field(default_factory=dict)

    def add(self, other: "Bucket") -> None:
        """Take in what is left of other samples."""
        self.count += other.count
        fields = self.fields
        for name, new in other.fields.items():
            old = fields.get(name)
            fields[name] = new if old is None else _together(old, new)

    def data(self) -> dict[str, Any]:
        """As a row holds it."""
        return {"count": self.count, "fields": self.fields}


def bucket(data: Mapping[str, Any]) -> Bucket:
    """The bucket in a row."""
    return Bucket(data["count"], {name: Summary(*values) for name, values in data["fields"].items()})


def summarize(samples: Samples) -> Bucket:
    """What is left of some samples."""
    times = samples.at_ms
    made = Bucket(len(times))
    for name, values in samples.columns.items():
        total = sum(values)
        if total == total:  # noqa: PLR0124 (no NaN among them)
            made.fields[name] = Summary(len(values), total, min(values), max(values), values[-1], times[-1])
            continue
        there = [index for index, value in enumerate(values) if not math.isnan(value)]
        if there:
            some = [values[index] for index in there]
            made.fields[name] = Summary(len(some), sum(some), min(some), max(some), some[-1], times[there[-1]])
    return made


def _together(one: Summary, other: Summary) -> Summary:
    last = one if one.last_ms > other.last_ms else other
    return Summary(
        one.samples + other.samples,
        one.total + other.total,
        min(one.low, other.low),
        max(one.high, other.high),
        last.last,
        last.last_ms,
    )


def _nothing(count: int) -> "array[float]":
    return array("d", [_NAN]) * count


# ---------------------------------------------------------------- how long, how fine


@dataclass(frozen=True, slots=True, kw_only=True)
class RetentionPolicy:
    """How long what is kept [ms]; what is not named is kept for ever.

    The times that a window has seen are in its raw row: with it goes the promise that a sample counts once, so nothing
    older than that may still come.
    """

    raw_ms: int = 24 * 3_600_000
    levels_ms: Mapping[str, int] = field(
        default_factory=lambda: {"10s": 7 * DAY.span_ms, "1min": 90 * DAY.span_ms, "10min": 730 * DAY.span_ms}
    )

    def of(self, level: Level) -> int | None:
        """How long the rows of a level are kept at least, from the end of their day; ``None``: for ever."""
        if level == RAW:
            return self.raw_ms
        kept_ms = self.levels_ms.get(level.name)
        return None if kept_ms is None else max(kept_ms, self.raw_ms)


def finest_level(first_ms: int, last_ms: int, *, points: int, now_ms: int, keep: RetentionPolicy) -> Level:
    """The finest buckets of which no more than ``points`` cover the time, and which are still there for all of it."""
    for level in LEVELS:
        covering = (floor(last_ms - 1, level.span_ms) - floor(first_ms, level.span_ms)) // level.span_ms + 1
        kept_ms = keep.of(level)
        if covering <= points and (kept_ms is None or floor(first_ms, DAY.span_ms) + DAY.span_ms + kept_ms > now_ms):
            return level
    return LEVELS[-1]
