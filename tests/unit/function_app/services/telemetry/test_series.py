"""Each sample of a series is stored once, independent of sender, repetition and order."""

import asyncio
import math
import random
from typing import Any

import pytest

from function_app.domain.common.problems import Problem
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import DAY, FINEST, LEVELS, RAW, RetentionPolicy
from function_app.services.storage import records
from function_app.services.telemetry.series_reader import Range
from function_app.services.telemetry.series_writer import ABOUT, MAX_STREAMS, SeriesWriter
from tests.unit.function_app.services.telemetry.telemetry_fixture import (
    ANNA,
    DEVICE,
    NOW_MS,
    PLACE,
    TelemetrySetup,
    assert_whole,
    some_rows,
)

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("seed", range(4))
async def test_every_sample_is_stored_once_in_any_order(setup: TelemetrySetup, seed: int) -> None:
    chance = random.Random(seed)  # noqa: S311 (the same each time)
    rows = some_rows(chance, 400)
    pieces = [{at_ms: rows[at_ms] for at_ms in chance.sample(sorted(rows), 25)} for _ in range(60)]
    pieces += [{at_ms: values} for at_ms, values in rows.items()]
    chance.shuffle(pieces)
    writers = [setup.instance()[2] for _ in range(4)]
    new = 0
    for begin in range(0, len(pieces), 4):
        added = await asyncio.gather(
            *(
                writer.add(PLACE, series.from_rows(piece.items()))
                for writer, piece in zip(writers, pieces[begin:], strict=False)
            )
        )
        new += sum(map(len, added))
    assert new == len(rows)
    await assert_whole(setup, rows)


@pytest.mark.parametrize(("fields", "every_ms"), [(100, 100), (250, 400)])
async def test_large_windows_are_written_in_several_batches(setup: TelemetrySetup, fields: int, every_ms: int) -> None:
    chance = random.Random(3)  # noqa: S311 (the same each time)
    begin_ms = series.floor(NOW_MS, 60_000) - 600_000
    names = [f"{'x' * 77}{number:03d}" for number in range(fields)]
    rows = {begin_ms + at_ms: {name: -chance.random() for name in names} for at_ms in range(0, 300_000, every_ms)}
    for _ in range(2):
        new = await setup.writer.add(PLACE, series.from_rows(rows.items()))
    assert len(new) == 0
    part = await setup.read(level="1h", points=10)
    summaries = [summary for summary in part.summaries[names[7]] if summary is not None]
    assert sum(summary.samples for summary in summaries) == len(rows)


async def test_samples_too_old_or_ahead_of_time_are_dropped(setup: TelemetrySetup) -> None:
    valid = {NOW_MS - setup.keep.raw_ms: {"a": 1.0}, NOW_MS: {"a": 2.0}, NOW_MS + 60_000: {"a": 3.0}}
    refused = {NOW_MS - setup.keep.raw_ms - 1: {"a": 4.0}, NOW_MS + 400_000: {"a": 5.0}, 0: {"a": 6.0}}
    await setup.writer.add(PLACE, series.from_rows((valid | refused).items()))
    await assert_whole(setup, valid)


async def test_streams_per_device_and_fields_per_stream_are_limited(setup: TelemetrySetup) -> None:
    for number in range(MAX_STREAMS + 1):
        new = await setup.writer.add(PLACE._replace(stream=f"s{number}"), series.from_rows([(NOW_MS, {"a": 1.0})]))
        assert len(new) == (number < MAX_STREAMS)
    assert len(await setup.reader.streams(ANNA, DEVICE)) == MAX_STREAMS
    many = {NOW_MS + n: {f"f{n}": 1.0} for n in range(2 * series.MAX_FIELDS)}
    await setup.writer.add(PLACE._replace(stream="s1"), series.from_rows(many.items()))
    part = await setup.read("s1", level="1d")
    assert len(part.summaries) == series.MAX_FIELDS


async def test_a_live_stream_is_read_again_only_after_another_writer(setup: TelemetrySetup) -> None:
    rows: dict[int, dict[str, float]] = {}
    reads = 0
    real = setup.writer._read

    async def counted(*arguments: Any) -> Any:
        nonlocal reads
        reads += 1
        return await real(*arguments)

    setup.writer._read = counted  # type: ignore[assignment, method-assign]
    other = setup.instance()[2]

    async def add(writer: SeriesWriter, number: int) -> None:
        new = {setup.clock.at_ms + 100 * n: {"a": float(n)} for n in range(number * 50, number * 50 + 50)}
        rows.update(new)
        assert len(await writer.add(PLACE, series.from_rows(new.items()))) == 50

    for number in range(20):
        await add(setup.writer, number)
    assert reads == 1
    await add(other, 20)
    await add(setup.writer, 21)
    assert reads == 2
    assert len(await setup.writer.add(PLACE, series.from_rows(rows.items()))) == 0
    await assert_whole(setup, rows)


async def test_few_samples_are_returned_raw_and_many_in_buckets(setup: TelemetrySetup) -> None:
    rows = {NOW_MS - 3_600_000 + 1000 * n: {"a": float(n)} for n in range(3600)}
    await setup.writer.add(PLACE, series.from_rows(rows.items()))
    few = await setup.read(first_ms=NOW_MS - 60_000, last_ms=NOW_MS, points=100)
    assert few.level == RAW
    values = dict(zip(few.at_ms, few.values["a"], strict=True))
    assert values == {at_ms: each["a"] for at_ms, each in rows.items() if at_ms >= NOW_MS - 60_000}
    assert (await setup.read(points=500)).level == FINEST
    coarse = await setup.read(points=100)
    assert coarse.level.name == "1min"
    assert len(coarse.at_ms) <= 100


async def test_pages_continue_at_the_cursor(setup: TelemetrySetup) -> None:
    rows = {NOW_MS - 3_600_000 + 700 * n: {"a": float(n)} for n in range(5000)}
    await setup.writer.add(PLACE, series.from_rows(rows.items()))
    for level in (RAW, FINEST):
        found: list[int] = []
        cursor: str | None = None
        expected = sorted({series.floor(at_ms, max(1, level.span_ms)) for at_ms in rows})
        for _ in range(math.ceil(len(expected) / 170)):
            part = await setup.read(level=level.name, points=170, cursor=cursor)
            assert 0 < len(part.at_ms) <= 170
            found += part.at_ms
            cursor = part.cursor
        assert (found, cursor) == (expected, None)


@pytest.mark.parametrize("stream", ["other", "", "a/b", "..", "\ud800", "x" * 600])
async def test_a_missing_stream_is_unknown(setup: TelemetrySetup, stream: str) -> None:
    with pytest.raises(Problem) as caught:
        await setup.read(stream)
    assert caught.value.code == "stream-unknown"


async def test_each_level_is_deleted_after_its_retention(setup: TelemetrySetup) -> None:
    day_ms = DAY.span_ms
    setup.keep = RetentionPolicy(raw_ms=day_ms, levels_ms={"10s": 2 * day_ms, "1min": 3 * day_ms, "10min": 5 * day_ms})
    reader, _, writer, retention = setup.instance()
    rows = {NOW_MS - 1000 * n: {"a": float(n)} for n in range(500)}
    await writer.add(PLACE, series.from_rows(rows.items()))
    end_ms = series.floor(NOW_MS, day_ms) + day_ms
    retention_days = {"raw": 1, "10s": 2, "1min": 3, "10min": 5}
    for days in range(8):
        setup.clock.at_ms = end_ms + days * day_ms + 2 * 3_600_000
        for _ in range(5):
            await retention.delete_due(setup.clock.at_ms)
        for level in (RAW, *LEVELS):
            part = await reader.read(ANNA, DEVICE, "health", Range(level=level.name, points=1000))
            assert bool(part.at_ms) == (days < retention_days.get(level.name, 1000)), (level, days)
    part = await reader.read(ANNA, DEVICE, "health", Range())
    assert part.level.name == "1h"
    assert sum(summary.samples for summary in part.summaries["a"] if summary) == 500


async def test_every_written_row_has_a_scheduled_deletion(setup: TelemetrySetup) -> None:
    """Every row of a limited level is in the range of a scheduled deletion."""
    chance = random.Random(9)  # noqa: S311 (the same each time)
    rows = some_rows(chance, 300, span_ms=setup.keep.raw_ms)
    await setup.writer.add(PLACE, series.from_rows(rows.items()))
    pages = [await setup.tables.query(records.FORGET, str(shard), limit=1000) for shard in range(8)]
    ranges = [(note.data["first"], note.data["last"]) for page in pages for note in page.rows]
    assert len(ranges) == 2 * 4  # two days, four levels with limited retention
    page = await setup.tables.query(records.SERIES, PLACE.partition, limit=1000)
    for row in page.rows:
        unlimited = row.key == ABOUT or row.key.startswith(("1h:", "6h:", "1d:"))
        assert any(first <= row.key < last for first, last in ranges) != unlimited, row.key
