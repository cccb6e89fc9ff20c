"""Reads time series: the streams of a device, and ranges at a suitable resolution."""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from device_agent.protocol import topics
from function_app.domain.common.problems import invalid, not_found
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import (
    FINEST,
    LEVELS,
    RAW,
    WINDOW_MS,
    Level,
    RetentionPolicy,
    Samples,
    Summary,
)
from function_app.ports.clock import Clock
from function_app.ports.tables import Tables
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.storage import records
from function_app.services.telemetry.series_writer import ABOUT, MAX_STREAMS, Place, StreamInfo

MAX_POINTS = 1_000
_DIGITS = 13
"""Number of digits of a time in a key [ms]."""
RAW_ROWS = 100
"""Windows per query for raw samples."""
RAW_QUERIES = 10
"""Queries per page of raw samples: with sparse windows a page ends early, with a cursor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Range:
    """A range to read: ``first_ms`` ≤ time < ``last_ms``.

    Attributes:
        first_ms: ``None``: from the beginning.
        last_ms: ``None``: to the end.
        points: Maximum number of points per page.
        level: Resolution; ``None``: the finest with at most ``points`` points.
        fields: Fields; ``None``: all.
        cursor: Cursor of the previous page.
    """

    first_ms: int | None = None
    last_ms: int | None = None
    points: int = 500
    level: str | None = None
    fields: Sequence[str] | None = None
    cursor: str | None = None


@dataclass(slots=True)
class Part:
    """One page: times, and for each field a value or summary per time; ``None``: missing."""

    level: Level
    first_ms: int
    last_ms: int
    at_ms: list[int] = field(default_factory=list)
    values: dict[str, list[float | None]] = field(default_factory=dict)
    summaries: dict[str, list[Summary | None]] = field(default_factory=dict)
    cursor: str | None = None


class _Query(NamedTuple):
    """A range with all defaults resolved."""

    place: Place
    first_ms: int
    last_ms: int
    points: int
    names: Sequence[str]


class StreamView(NamedTuple):
    """A stream and its metadata."""

    name: str
    about: StreamInfo


class SeriesReader:
    """Reads what ``SeriesWriter`` has written."""

    def __init__(self, *, tables: Tables, devices: DeviceAccess, keep: RetentionPolicy, clock: Clock) -> None:
        self._tables = tables
        self._devices = devices
        self._keep = keep
        self._clock = clock

    async def streams(self, caller: Identity, device: str) -> list[StreamView]:
        """The streams of a device, by name.

        Raises:
            Problem: ``device-unknown``.
        """
        result = await self._devices.get(caller, device)
        place = Place(result.id, result.pairing, "")
        listed = await self._tables.query(records.SERIES, place.streams, limit=MAX_STREAMS)
        views = await asyncio.gather(*(self._about(place._replace(stream=row.key)) for row in listed.rows))
        return [StreamView(row.key, about) for row, about in zip(listed.rows, views, strict=True) if about is not None]

    async def read(self, caller: Identity, device: str, stream: str, range_: Range) -> Part:
        """A page of one stream.

        Raises:
            Problem: ``device-unknown``, ``stream-unknown``, ``invalid``, ``cursor-invalid``.
        """
        result = await self._devices.get(caller, device)
        place = Place(result.id, result.pairing, stream)
        about = await self._about(place)
        if about is None:
            raise not_found("stream", stream)
        level = None if range_.level is None else _level(range_.level)
        first_ms = max(range_.first_ms or 0, about.first_ms)
        last_ms = about.last_ms + 1
        if range_.last_ms is not None:
            last_ms = min(range_.last_ms, last_ms)
        if range_.cursor is not None:
            level, first_ms = _read_cursor(range_.cursor)
        if first_ms >= last_ms:
            return Part(level or FINEST, first_ms, max(first_ms, last_ms))
        query = _Query(place, first_ms, last_ms, range_.points, _field_names(range_.fields, about))
        if level == RAW:
            return await self._raw(query)
        if level is not None:
            part, _ = await self._buckets(level, query)
            return part
        now_ms = self._clock.now_ms()
        level = series.finest_level(first_ms, last_ms, points=range_.points, now_ms=now_ms, keep=self._keep)
        part, samples = await self._buckets(level, query)
        if level == FINEST and samples <= range_.points and first_ms > now_ms - self._keep.raw_ms:
            return await self._raw(query)
        return part

    async def _about(self, place: Place) -> StreamInfo | None:
        row = await self._tables.get(records.SERIES, place.partition, ABOUT) if topics.is_id(place.stream) else None
        return None if row is None else records.read(row, StreamInfo)

    async def _buckets(self, level: Level, query: _Query) -> tuple[Part, int]:
        """A page of buckets, and their number of samples."""
        page = await self._tables.query(
            records.SERIES,
            query.place.partition,
            first=series.key(level, series.floor(query.first_ms, level.span_ms)),
            last=series.key(level, query.last_ms),
            limit=query.points,
        )
        part = Part(level, query.first_ms, query.last_ms, summaries={name: [] for name in query.names})
        samples = 0
        for row in page.rows:
            bucket = series.bucket(row.data)
            samples += bucket.count
            part.at_ms.append(series.start_of(row.key))
            for name, summaries in part.summaries.items():
                summaries.append(bucket.fields.get(name))
        if page.cursor is not None:
            part.cursor = _write_cursor(level, part.at_ms[-1] + level.span_ms)
        return part, samples

    async def _raw(self, query: _Query) -> Part:
        """A page of raw samples."""
        part = Part(RAW, query.first_ms, query.last_ms, values={name: [] for name in query.names})
        begin_ms = series.floor(query.first_ms, WINDOW_MS)
        rows = min(RAW_ROWS, query.points)
        for _ in range(RAW_QUERIES):
            page = await self._tables.query(
                records.SERIES,
                query.place.partition,
                first=series.key(RAW, begin_ms),
                last=series.key(RAW, query.last_ms),
                limit=rows,
            )
            for row in page.rows:
                samples_ = series.unpack(row.data).between(query.first_ms, query.last_ms)
                left = query.points - len(part.at_ms)
                if len(samples_) > left:
                    part.cursor = _write_cursor(RAW, samples_.at_ms[left])
                    samples_ = samples_.part(0, left)
                _extend(part, samples_)
                if part.cursor is not None:
                    return part
            if page.cursor is None:
                return part
            begin_ms = series.start_of(page.rows[-1].key) + WINDOW_MS
        part.cursor = _write_cursor(RAW, begin_ms)
        return part


def _extend(part: Part, samples: Samples) -> None:
    part.at_ms.extend(samples.at_ms)
    for name, values in part.values.items():
        column = samples.columns.get(name)
        if column is None:
            values.extend([None] * len(samples))
        else:
            values.extend(None if math.isnan(value) else value for value in column)


def _field_names(fields: Sequence[str] | None, about: StreamInfo) -> Sequence[str]:
    if fields is None:
        return about.fields
    unknown = [name for name in fields if name not in about.fields]
    if unknown:
        available = ", ".join(about.fields[:20])
        raise invalid(f"The stream has no field '{unknown[0][:80]}'. It has: {available}.", code="field-unknown")
    return list(dict.fromkeys(fields))


def _level(name: str) -> Level:
    for level in (RAW, *LEVELS):
        if level.name == name:
            return level
    raise invalid(f"The resolution is one of {', '.join(level.name for level in (RAW, *LEVELS))}.")


def _write_cursor(level: Level, at_ms: int) -> str:
    return f"{level.name}.{at_ms}"


def _read_cursor(cursor: str) -> tuple[Level, int]:
    name, _, at = cursor.partition(".")
    level = next((level for level in (RAW, *LEVELS) if level.name == name), None)
    if level is None or not at.isascii() or not at.isdecimal() or len(at) > _DIGITS:
        raise invalid("The cursor is not valid for this list. Start without a cursor.", code="cursor-invalid")
    return level, int(at)
