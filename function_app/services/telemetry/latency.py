"""Latencies measured by operators, agents and the cloud, as histograms per hour and day.

Partition of ``Latency``: device and pairing. Keys: ``hour:<transport>:<path>:<start>`` and ``day:…`` contain
histograms, ``recent:<transport>:<path>`` the newest samples, ``once:<day>:<hash>`` marks a stored batch.
"""

import asyncio
import hashlib
import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, cast

from function_app.domain.actions.action import Action
from function_app.domain.common.problems import Problem, invalid
from function_app.domain.devices.devices import Device
from function_app.domain.telemetry import histogram
from function_app.domain.telemetry.histogram import Histogram
from function_app.ports.clock import Clock
from function_app.ports.tables import Row, StoreError, Tables, Write
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, Retention

Transport = Literal["mqtt", "websocket", "http", "http-poll", "xmpp"]
"""Transport of the message: ``http`` is long polling, ``http-poll`` plain polling at an interval."""
Path = Literal[
    "operator-device", "operator-cloud", "device-cloud", "command-answered", "command-started", "received-started"
]
"""Measured path; each uses one clock. Round trips use the clock of the operator (``operator-device``,
``operator-cloud``) or the agent (``device-cloud``). ``command-answered`` and ``command-started`` use the cloud
clock, ``received-started`` the agent clock.
"""

HOUR_MS = 3_600_000
RECENT = 1_000
"""Number of newest samples that are stored individually."""
OLDEST_MS = 7 * DAY_MS
NEWEST_MS = HOUR_MS
"""Maximum age of a sample, and maximum lead of its clock [ms]."""
BY_HOUR_MS = 40 * DAY_MS
"""Longest span that is summed from hours; longer spans are summed from days."""
LONGEST_SPAN_MS = 990 * DAY_MS
KEEP_HOURS_MS = 90 * DAY_MS
"""Time that hours are stored; days are stored without limit."""
_HOURS_A_BATCH = 40
"""With their days, newest samples and marker they stay below the batch limit of the tables."""


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of one kind: time by the sender's clock [ms since 1970], and duration [ms]."""

    transport: Transport
    path: Path
    samples: tuple[tuple[int, float], ...]

    def fingerprint(self) -> str:
        """A hash that is equal for equal samples."""
        text = json.dumps([self.transport, self.path, self.samples])
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class LatencySeries:
    """Latencies of one transport and path in a time span; ``recent`` contains the newest samples in order of time."""

    transport: Transport
    path: Path
    histogram: Histogram
    recent: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Span:
    """A time span (end exclusive) [ms since 1970], in whole hours or days."""

    first_ms: int
    last_ms: int
    step_ms: int


@dataclass(frozen=True, slots=True)
class _Recent:
    samples: tuple[tuple[int, float], ...] = field(default_factory=tuple)


class LatencyStore:
    """Stores latencies."""

    def __init__(self, *, tables: Tables, retention: Retention, clock: Clock) -> None:
        self._tables = tables
        self._retention = retention
        self._clock = clock

    async def add(self, device: Device, batch: Samples, *, caller: str, idempotency_key: str = "") -> None:
        """Add samples. Idempotent by ``idempotency_key``, or by equality of the samples.

        Raises:
            Problem: ``invalid``: an impossible time; ``idempotency-key-reused``; ``busy``.
        """
        self._check(batch)
        fingerprint = batch.fingerprint()
        name = idempotency_key or fingerprint
        day = max(at_ms for at_ms, _ in batch.samples) // DAY_MS
        mark = _mark(day) + hashlib.sha256(f"{caller}\n{name}".encode()).hexdigest()
        hours: dict[int, list[tuple[int, float]]] = {}
        for sample in batch.samples:
            hours.setdefault(sample[0] // HOUR_MS, []).append(sample)
        starts = sorted(hours)
        for number, first in enumerate(range(0, len(starts), _HOURS_A_BATCH)):
            part = [sample for hour in starts[first : first + _HOURS_A_BATCH] for sample in hours[hour]]
            parts = {f"{batch.transport}:{batch.path}": part}
            place = _partition(device.id, device.pairing)
            await records.retry(partial(self._count, place, f"{mark}:{number}", fingerprint, parts))

    async def measured(self, action: Action, transport: Transport) -> None:
        """Add the latencies of an ended action in the background. Idempotent."""
        samples = _latencies(action)
        if not samples:
            return
        parts = {f"{transport}:{path}": [sample] for path, sample in samples.items()}
        mark = _mark(action.issued_ms // DAY_MS) + hashlib.sha256(action.id.encode()).hexdigest()
        place = _partition(action.device, action.pairing)
        try:
            await records.retry(partial(self._count, place, mark, action.id, parts))
        except (Problem, StoreError) as error:
            _log.warning("times of action %s: %s", action.id, error)

    async def find(
        self, device: Device, span: Span, *, transport: Transport | None = None, path: Path | None = None
    ) -> list[LatencySeries]:
        """Latencies in ``span`` for each transport and path with samples, sorted by name."""
        partition = _partition(device.id, device.pairing)
        first, last = "recent:", "recent;"
        page = await self._tables.query(records.LATENCY, partition, first=first, last=last, limit=1000)
        stored = []
        for row in page.rows:
            _, of_transport, of_path = row.key.split(":")
            if transport in {None, of_transport} and path in {None, of_path}:
                stored.append((of_transport, of_path, records.read(row, _Recent).samples))
        sums = await asyncio.gather(*(self._sum(partition, f"{one}:{other}", span) for one, other, _ in stored))
        return [
            LatencySeries(cast("Transport", of_transport), cast("Path", of_path), total, recent)
            for (of_transport, of_path, recent), total in zip(stored, sums, strict=True)
        ]

    def span(self, first_ms: int | None, last_ms: int | None) -> Span:
        """The requested span, extended to whole hours or days; by default the last 24 hours.

        Raises:
            Problem: ``invalid``.
        """
        until_ms = self._clock.now_ms() if last_ms is None else last_ms
        since_ms = until_ms - DAY_MS if first_ms is None else first_ms
        if not 0 <= since_ms < until_ms:
            raise invalid("'from' must be before 'to'.")
        if until_ms - since_ms > LONGEST_SPAN_MS:
            raise invalid(f"Request at most {LONGEST_SPAN_MS // DAY_MS} days.")
        step_ms = HOUR_MS if until_ms - since_ms <= BY_HOUR_MS else DAY_MS
        return Span(since_ms // step_ms * step_ms, -(-until_ms // step_ms) * step_ms, step_ms)

    def _check(self, batch: Samples) -> None:
        now_ms = self._clock.now_ms()
        for at_ms, ms in batch.samples:
            if not now_ms - OLDEST_MS <= at_ms <= now_ms + NEWEST_MS:
                detail = f"at_ms {at_ms} is more than 7 days old or more than an hour ahead. Set the sender's clock."
                raise invalid(detail)
            if not 0 <= ms <= histogram.LONGEST_MS:
                raise invalid(f"A time is 0 to {histogram.LONGEST_MS:.0f} ms, not {ms}.")

    async def _count(
        self, partition: str, mark: str, fingerprint: str, parts: Mapping[str, Sequence[tuple[int, float]]]
    ) -> None:
        """Write one batch: histograms, newest samples and the marker."""
        existing = await self._tables.get(records.LATENCY, partition, mark)
        if existing is not None:
            if existing.data["fingerprint"] != fingerprint:
                detail = "This Idempotency-Key was used with other samples. Use a new key for new samples."
                raise invalid(detail, code="idempotency-key-reused")
            return
        groups: dict[tuple[str, str, int], list[float]] = {}
        for kind, part in parts.items():
            for at_ms, ms in part:
                groups.setdefault(("hour", kind, at_ms // HOUR_MS * HOUR_MS), []).append(ms)
                groups.setdefault(("day", kind, at_ms // DAY_MS * DAY_MS), []).append(ms)
        newest = {f"recent:{kind}": part for kind, part in parts.items()}
        rows = await self._rows(partition, [*(_key(*group) for group in groups), *newest])
        writes = [Write("create", Row(partition, mark, {"fingerprint": fingerprint}))]
        for key, part in newest.items():
            row = rows.get(key)
            recent = sorted([*(records.read(row, _Recent).samples if row else ()), *part])[-RECENT:]
            writes.append(_write(partition, key, _Recent(tuple(recent)), row))
        for group, times_ms in groups.items():
            row = rows.get(_key(*group))
            if row is None and group[0] == "day":
                await self._schedule_deletion(partition, *group[1:])
            total = histogram.merge([histogram.of(times_ms), records.read(row, Histogram) if row else Histogram()])
            writes.append(_write(partition, _key(*group), total, row))
        await self._tables.batch(records.LATENCY, writes)

    async def _schedule_deletion(self, partition: str, kind: str, day_ms: int) -> None:
        """Schedule the deletion of a new day's hours and markers, before they are written."""
        end_ms = day_ms + DAY_MS
        first, last = _key("hour", kind, day_ms), _key("hour", kind, end_ms)
        await self._retention.delete_rows_at(
            records.LATENCY, partition, first=first, last=last, due_ms=end_ms + KEEP_HOURS_MS
        )
        first, last = _mark(day_ms // DAY_MS), _mark(end_ms // DAY_MS)
        # After this time, samples of this day are rejected as too old.
        due_ms = end_ms + OLDEST_MS + DAY_MS
        await self._retention.delete_rows_at(records.LATENCY, partition, first=first, last=last, due_ms=due_ms)

    async def _rows(self, partition: str, keys: Iterable[str]) -> dict[str, Row]:
        rows = await asyncio.gather(*(self._tables.get(records.LATENCY, partition, key) for key in keys))
        return {row.key: row for row in rows if row is not None}

    async def _sum(self, partition: str, kind: str, span: Span) -> Histogram:
        step = "hour" if span.step_ms == HOUR_MS else "day"
        first, last = (_key(step, kind, at_ms) for at_ms in (span.first_ms, span.last_ms))
        page = await self._tables.query(records.LATENCY, partition, first=first, last=last, limit=1000)
        return histogram.merge(records.read(row, Histogram) for row in page.rows)


def _write(partition: str, key: str, record: Any, old: Row | None) -> Write:
    return records.write(old, partition, key, records.to_data(record))


def _mark(day: int) -> str:
    return f"once:{day:06d}:"


def _key(step: str, kind: str, at_ms: int) -> str:
    return f"{step}:{kind}:{at_ms:014d}"


def _latencies(action: Action) -> dict[str, tuple[int, float]]:
    """Latencies of an action, as differences of one clock each. Negative differences are skipped."""
    result: dict[str, tuple[int, float]] = {}
    published_ms = action.times.get("published")
    if published_ms is not None and action.received:
        result["command-answered"] = (published_ms, min(action.received.values()) - published_ms)
        if "started" in action.received:
            result["command-started"] = (published_ms, action.received["started"] - published_ms)
    if {"received", "started"} <= set(action.times):
        result["received-started"] = (action.issued_ms, action.times["started"] - action.times["received"])
    return {path: sample for path, sample in result.items() if 0 <= sample[1] <= histogram.LONGEST_MS}


def _partition(device: str, pairing: str) -> str:
    return f"{device}/{pairing}"
