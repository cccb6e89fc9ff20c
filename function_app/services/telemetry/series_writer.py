"""Writes samples to their series, each sample once.

The raw window contains the stored times. All buckets of a sample change in the same batch.
"""

import asyncio
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import DAY, LEVELS, RAW, Bucket, Level, RetentionPolicy, Samples
from function_app.ports.clock import Clock
from function_app.ports.tables import MAX_BATCH, MAX_BATCH_BYTES, Conflict, Row, Tables, Write
from function_app.services.storage import records
from function_app.services.storage.records import retry
from function_app.services.storage.retention import Retention

ABOUT = "about"
"""Row key of a stream's metadata."""
MAX_STREAMS = 64
"""Maximum number of streams per device."""
AHEAD_MS = 300_000
"""Tolerated lead of a device clock; later samples are rejected."""
MARGIN_MS = 3_600_000
"""Additional time that rows remain, for slow writers and clock differences."""
MAX_CACHED = 100
"""Streams whose newest rows are cached."""
_MAX_BYTES = MAX_BATCH_BYTES * 3 // 4
"""Maximum size of a batch [bytes], with a reserve for metadata."""
_BYTES_PER_SUMMARY = 240
_BYTES_PER_NAME = 84

_log = logging.getLogger(__name__)


class Place(NamedTuple):
    """The place of a stream: device and pairing, so that a new owner cannot read earlier data."""

    device: str
    pairing: str
    stream: str

    def __str__(self) -> str:
        """For log lines, which operators read on the administration page."""
        return f"{self.stream} of {self.device}"

    @property
    def streams(self) -> str:
        """Partition that lists the streams of the device."""
        return f"{self.device}/{self.pairing}"

    @property
    def partition(self) -> str:
        """Partition of the stream."""
        return f"{self.device}/{self.pairing}/{self.stream}"


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Metadata of a stream: number of samples, first and last time, field names."""

    count: int = 0
    first_ms: int = 0
    last_ms: int = 0
    fields: tuple[str, ...] = ()


@dataclass(slots=True)
class _CachedRows:
    """Rows of one stream as read."""

    about: Row | None
    rows: dict[str, Row] = field(default_factory=dict)
    last_ms: int = 0
    """Start of the newest window in the rows."""

    def write(self, partition: str, key: str, data: dict[str, Any]) -> Write:
        """The write that creates or replaces a row."""
        row = self.about if key == ABOUT else self.rows.get(key)
        return records.write(row, partition, key, data)


_Windows = Sequence[tuple[int, Samples]]


class SeriesWriter:
    """Adds samples. Idempotent, safe to run concurrently, in any order."""

    def __init__(self, *, tables: Tables, retention: Retention, keep: RetentionPolicy, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._keep = keep
        self._clock = clock
        self._written: dict[str, _CachedRows] = {}

    async def add(self, place: Place, samples: Samples) -> Samples:
        """Add new samples; return those that were new.

        Samples that are too old or more than five minutes ahead are dropped and logged. Those of a stream with many
        fields are stored at the highest rate at which a window fits into a row; see ``series.fit_window``.

        Raises:
            Problem: ``busy``: some samples may be written. Retry.
            StoreError: As above.
        """
        now_ms = self._clock.now_ms()
        accepted = samples.between(now_ms - self._keep.raw_ms, now_ms + AHEAD_MS)
        if len(accepted) < len(samples):
            _log.warning("%s: %d samples are too old or ahead of time", place, len(samples) - len(accepted))
        new = Samples()
        for windows in _chunks(accepted):
            new = series.merge(new, await self._add(place, windows))
        return new

    async def forget(self, device: str, pairing: str) -> None:
        """Delete all streams of an ended pairing, after all processes have stopped writing."""
        due_ms = self._clock.now_ms() + MARGIN_MS
        place = Place(device, pairing, "")
        listed = await self._tables.query(records.SERIES, place.streams, limit=MAX_STREAMS)
        for row in listed.rows:
            partition = place._replace(stream=row.key).partition
            await self._retention.delete_rows_at(records.SERIES, partition, first="", last=None, due_ms=due_ms)
        await self._retention.delete_rows_at(records.SERIES, place.streams, first="", last=None, due_ms=due_ms)

    async def _add(self, place: Place, windows: _Windows) -> Samples:
        """Add samples in one batch, or in several if they do not fit."""
        first_ms, last_ms = windows[0][0], windows[-1][0]

        async def attempt() -> Samples | None:
            # Rows cached from the last write; their ETags show whether they are current.
            existing = self._written.pop(place.partition, None)
            if existing is None or first_ms < existing.last_ms:
                existing = await self._read(place.partition, first_ms, last_ms)
            return await self._write(place, windows, existing)

        written = await retry(attempt)
        if written is not None:
            return written
        half = len(windows) // 2
        return series.merge(await self._add(place, windows[:half]), await self._add(place, windows[half:]))

    async def _write(self, place: Place, windows: _Windows, existing: _CachedRows) -> Samples | None:
        """Decide and write; ``None``: too large for one batch.

        Raises:
            Conflict: Another process has written concurrently.
        """
        partition = place.partition
        about = records.read(existing.about, StreamInfo) if existing.about else StreamInfo()
        if existing.about is None and not await self._announce(place):
            return Samples()
        names = _names(about, windows)
        new = Samples()
        buckets: dict[str, Bucket] = {}
        writes: list[Write] = []
        for start_ms, window in windows:
            key = series.key(RAW, start_ms)
            row = existing.rows.get(key)
            stored = series.unpack(row.data) if row else Samples()
            created = series.new_samples(_only(window, names), stored)
            fitting = series.fit_window(created, stored)
            if not fitting:
                continue
            new = series.merge(new, fitting)
            writes.append(existing.write(partition, key, series.pack(series.merge(stored, fitting))))
            _into(buckets, existing, start_ms, series.summarize(fitting))
        if not new:
            return new
        size = sum(
            len(row["data"]) + _BYTES_PER_NAME * len(row["fields"]) for row in (each.row.data for each in writes)
        )
        size += _BYTES_PER_SUMMARY * sum(len(each.fields) for each in buckets.values())
        if size > _MAX_BYTES and len(windows) > 1:
            return None
        writes += (existing.write(partition, key, each.data()) for key, each in buckets.items())
        writes.append(existing.write(partition, ABOUT, records.to_data(_grown(about, new, names))))
        await self._note(partition, existing, buckets)
        self._cache_rows(partition, windows[-1][0], await self._tables.batch(records.SERIES, writes))
        return new

    def _cache_rows(self, partition: str, start_ms: int, written: Sequence[Row]) -> None:
        """Cache the rows that further samples of this window change, so that live streams need no reads."""
        rows = {row.key: row for row in written}
        about = rows.pop(ABOUT)
        keys = {series.key(level, _start(level, start_ms)) for level in (RAW, *LEVELS)}
        if keys <= rows.keys():
            while len(self._written) >= MAX_CACHED:
                self._written.pop(next(iter(self._written)))
            self._written[partition] = _CachedRows(about, {key: rows[key] for key in keys}, start_ms)

    async def _read(self, partition: str, first_ms: int, last_ms: int) -> _CachedRows:
        """All rows that samples between the two windows may change."""
        ranges = [(level, _start(level, first_ms), _start(level, last_ms)) for level in (RAW, *LEVELS)]
        keys = [(ABOUT, ABOUT), *((series.key(level, first), series.key(level, last)) for level, first, last in ranges)]
        pages = await asyncio.gather(*(self._rows(partition, first, last) for first, last in keys))
        rows = {row.key: row for page in pages for row in page}
        return _CachedRows(rows.pop(ABOUT, None), rows)

    async def _rows(self, partition: str, first: str, last: str) -> tuple[Row, ...]:
        if first == last:
            row = await self._tables.get(records.SERIES, partition, first)
            return (row,) if row else ()
        page = await self._tables.query(records.SERIES, partition, first=first, last=last + "\0", limit=MAX_BATCH)
        return page.rows

    async def _announce(self, place: Place) -> bool:
        """List a new stream; ``False``: the device has too many streams."""
        listed = await self._tables.query(records.SERIES, place.streams, limit=MAX_STREAMS)
        if any(row.key == place.stream for row in listed.rows):
            return True
        if len(listed.rows) == MAX_STREAMS:
            _log.warning("%s: the device has %d streams already; this one is not stored", place, MAX_STREAMS)
            return False
        try:
            await self._tables.create(records.SERIES, Row(place.streams, place.stream, {}))
        except Conflict:
            _log.debug("%s is listed already", place)
        return True

    async def _note(self, partition: str, existing: _CachedRows, buckets: dict[str, Bucket]) -> None:
        """Schedule the deletion of a new day's rows, before they are written."""
        for key in buckets:
            if not key.startswith(f"{DAY.name}:") or key in existing.rows:
                continue
            begin_ms = series.start_of(key)
            end_ms = begin_ms + DAY.span_ms
            for level in (RAW, *LEVELS):
                keep_ms = self._keep.of(level)
                if keep_ms is not None:
                    first, last = series.key(level, begin_ms), series.key(level, end_ms)
                    due_ms = end_ms + keep_ms + MARGIN_MS
                    await self._retention.delete_rows_at(
                        records.SERIES, partition, first=first, last=last, due_ms=due_ms
                    )


def _chunks(samples: Samples) -> Iterator[_Windows]:
    """Time spans whose rows fit into one batch."""
    chunk: list[tuple[int, Samples]] = []
    keys: set[str] = {ABOUT}
    for start_ms, window in samples.windows():
        touched = {series.key(level, _start(level, start_ms)) for level in (RAW, *LEVELS)}
        if len(keys | touched) > MAX_BATCH:
            yield chunk
            chunk, keys = [], {ABOUT}
        chunk.append((start_ms, window))
        keys |= touched
    if chunk:
        yield chunk


def _start(level: Level, at_ms: int) -> int:
    return series.floor(at_ms, level.span_ms or series.WINDOW_MS)


def _into(buckets: dict[str, Bucket], existing: _CachedRows, start_ms: int, summary: Bucket) -> None:
    """Add a summary to all buckets that contain the window."""
    for level in LEVELS:
        key = series.key(level, _start(level, start_ms))
        if key not in buckets:
            buckets[key] = series.bucket(existing.rows[key].data) if key in existing.rows else Bucket()
        buckets[key].add(summary)


def _names(about: StreamInfo, windows: _Windows) -> dict[str, None]:
    """The fields of the stream: existing ones, and new ones up to the limit."""
    names = dict.fromkeys(about.fields)
    for _, window in windows:
        for name in window.columns:
            if len(names) < series.MAX_FIELDS:
                names.setdefault(name)
    return names


def _only(samples: Samples, names: dict[str, None]) -> Samples:
    if all(name in names for name in samples.columns):
        return samples
    return Samples(samples.at_ms, {name: values for name, values in samples.columns.items() if name in names})


def _grown(about: StreamInfo, new: Samples, names: dict[str, None]) -> StreamInfo:
    return StreamInfo(
        count=about.count + len(new),
        first_ms=min(about.first_ms, new.at_ms[0]) if about.count else new.at_ms[0],
        last_ms=max(about.last_ms, new.at_ms[-1]),
        fields=tuple(names),
    )
