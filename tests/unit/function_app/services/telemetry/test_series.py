"""Samples into their series and out again: each counts once, whoever sends it how often and in whatever order."""

import asyncio
import math
import random
from collections.abc import AsyncIterator, Sequence
from typing import Any

import pytest

from device_agent.protocol import Description, Joint, JointTelemetry, Measurements, Mode, codec, topics
from device_agent.protocol.topics import Topic
from function_app.adapters.local.blobs import FileBlobs
from function_app.adapters.local.tables import SqliteTables
from function_app.domain.common.problems import Problem
from function_app.domain.devices.devices import Agent, Device, DeviceSpec
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import DAY, FINEST, LEVELS, RAW, RetentionPolicy, Samples
from function_app.ports.tables import Row, StoreError, Tables
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.storage import records
from function_app.services.storage.retention import Retention
from function_app.services.telemetry.ingest import (
    GIVE_UP_MS,
    LEFT_MS,
    SHARDS,
    InboundMessage,
    TelemetryIngest,
    Values,
    _Part,
)
from function_app.services.telemetry.series_reader import Part, Range, SeriesReader
from function_app.services.telemetry.series_writer import ABOUT, MAX_STREAMS, Place, SeriesWriter

pytestmark = pytest.mark.anyio

AGENT = "abcdefghij"
DEVICE = f"{AGENT}-arm"
ANNA = Identity("anna", "anna", "s1")
PLACE = Place(DEVICE, "p1", "health")
NOW_MS = 1_800_000_000_000
"""Some moment; not the beginning of a day."""


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Clock:
    def __init__(self) -> None:
        self.at_ms = NOW_MS

    def now_ms(self) -> int:
        return self.at_ms


class Killed(BaseException):
    """The process ends here."""


class Spoilt:
    """Tables that fail at a write: before it is done, or after."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.left: int | None = None
        self.after = False
        self.error: BaseException = Killed()

    def __getattr__(self, name: str) -> Any:
        real = getattr(self._tables, name)
        if name not in {"create", "replace", "delete", "batch"}:
            return real

        async def write(*arguments: Any) -> Any:
            if self.left is not None:
                if self.left == 0 and not self.after:
                    raise self.error
                self.left -= 1
            done = await real(*arguments)
            if self.left is not None and self.left < 0:
                raise self.error
            return done

        return write


class House:
    """The services over SQLite, and one agent with an arm that is Anna's."""

    def __init__(self, tables: Tables, blobs: FileBlobs) -> None:
        self.clock = Clock()
        self.keep = RetentionPolicy()
        self.tables = Spoilt(tables)
        self.seen: list[tuple[str, str, Sequence[tuple[int, Values]]]] = []
        self.blobs = blobs
        self.reader, self.intake, self.writer, self.forget = self.instance()

    def instance(self) -> tuple[SeriesReader, TelemetryIngest, SeriesWriter, Retention]:
        tables: Any = self.tables
        forget = Retention(tables=tables, blobs=self.blobs)
        writer = SeriesWriter(tables=tables, retention=forget, keep=self.keep, clock=self.clock)
        devices = DeviceAccess(tables=tables, clock=self.clock)
        intake = TelemetryIngest(tables=tables, writer=writer, clock=self.clock, observers=[self.observe])
        return SeriesReader(tables=tables, devices=devices, keep=self.keep, clock=self.clock), intake, writer, forget

    async def observe(self, device: Device, stream: str, means: Sequence[tuple[int, Values]]) -> None:
        self.seen.append((device.id, stream, means))

    async def pair(self, *, pairing: str = "p1", account: str = "anna") -> None:
        agent = Agent(
            id=AGENT,
            name="lab",
            public_key="",
            software="",
            devices=(DeviceSpec("arm", "arm", "ur5", "Arm"),),
            created_ms=0,
            account=account,
            space="space",
            pairing=pairing,
        )
        await records.upsert(self.tables, records.AGENTS, AGENT, "agent", lambda _: agent, Agent)

    async def read(self, stream: str = "health", **wanted: Any) -> Part:
        return await self.reader.read(ANNA, DEVICE, stream, Range(**wanted))


@pytest.fixture
async def house(tmp_path: Any) -> AsyncIterator[House]:
    tables = SqliteTables(tmp_path / "tables.sqlite")
    house = House(tables, FileBlobs(tmp_path / "blobs"))
    await house.pair()
    yield house
    await tables.close()


def message(at_ms: int, stream: str = "health", /, **values: float) -> InboundMessage:
    body = Measurements(tick_ms=at_ms, at_ms=at_ms, sequence=0, values=dict(values))
    return InboundMessage(Topic("space", AGENT, "arm", topics.TELE, stream), codec.encode(body))


def values_of(part: Part, name: str) -> dict[int, float | None]:
    return dict(zip(part.at_ms, part.values[name], strict=True))


async def assert_whole(house: House, rows: dict[int, dict[str, float]], stream: str = "health") -> None:
    """Every level of the series holds exactly these samples."""
    (view,) = [view for view in await house.reader.streams(ANNA, DEVICE) if view.name == stream]
    assert view.about.count == len(rows)
    assert (view.about.first_ms, view.about.last_ms) == (min(rows), max(rows))
    names = {name for values in rows.values() for name in values}
    assert set(view.about.fields) == names
    found: dict[int, dict[str, float]] = {}
    cursor: str | None = None
    while True:
        part = await house.read(stream, level="raw", points=1000, cursor=cursor)
        for index, at_ms in enumerate(part.at_ms):
            assert at_ms not in found
            found[at_ms] = {name: value for name in names if (value := part.values[name][index]) is not None}
        cursor = part.cursor
        if cursor is None:
            break
    assert found == rows
    for level in LEVELS:
        part = await house.read(stream, level=level.name, points=1000)
        assert part.cursor is None
        starts = sorted({series.floor(at_ms, level.span_ms) for at_ms in rows})
        assert part.at_ms == starts
        for name in names:
            for start_ms, summary in zip(part.at_ms, part.summaries[name], strict=True):
                inside = [
                    values[name]
                    for at_ms, values in sorted(rows.items())
                    if start_ms <= at_ms < start_ms + level.span_ms and name in values
                ]
                if summary is None:
                    assert not inside
                    continue
                assert (summary.samples, summary.low, summary.high) == (len(inside), min(inside), max(inside))
                assert summary.last == inside[-1]
                assert summary.total == pytest.approx(math.fsum(inside), rel=1e-9, abs=1e-9)


def some_rows(chance: random.Random, count: int, span_ms: int = 200_000) -> dict[int, dict[str, float]]:
    times = chance.sample(range(NOW_MS - span_ms, NOW_MS), count)
    return {
        at_ms: {name: chance.uniform(-100, 100) for name in chance.sample(["a", "b.x", "c"], chance.randint(1, 3))}
        for at_ms in times
    }


@pytest.mark.parametrize("seed", range(4))
async def test_every_sample_counts_once_however_it_comes(house: House, seed: int) -> None:
    chance = random.Random(seed)  # noqa: S311 (the same each time)
    rows = some_rows(chance, 400)
    pieces: list[dict[int, dict[str, float]]] = []
    for _ in range(60):
        times = chance.sample(sorted(rows), 25)
        pieces.append({at_ms: rows[at_ms] for at_ms in times})
    pieces += [{at_ms: values} for at_ms, values in rows.items()]
    chance.shuffle(pieces)
    writers = [house.instance()[2] for _ in range(4)]
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
    await assert_whole(house, rows)


async def test_a_long_stretch_is_split_into_batches(house: House) -> None:
    rows = {NOW_MS - 3_600_000 + 2000 * n: {"a": float(n), "b": n / 7} for n in range(1800)}
    new = await house.writer.add(PLACE, series.from_rows(rows.items()))
    assert len(new) == len(rows)
    assert len(await house.writer.add(PLACE, series.from_rows(rows.items()))) == 0
    await assert_whole(house, rows)


@pytest.mark.parametrize(("fields", "every_ms"), [(100, 100), (250, 400)])
async def test_windows_that_are_too_large_for_one_batch_are_written_in_several(
    house: House, fields: int, every_ms: int
) -> None:
    chance = random.Random(3)  # noqa: S311 (the same each time)
    begin_ms = series.floor(NOW_MS, 60_000) - 600_000
    names = [f"{'x' * 77}{number:03d}" for number in range(fields)]
    rows = {begin_ms + at_ms: {name: -chance.random() for name in names} for at_ms in range(0, 300_000, every_ms)}
    for _ in range(2):
        new = await house.writer.add(PLACE, series.from_rows(rows.items()))
    assert len(new) == 0
    part = await house.read(level="1h", points=10)
    summaries = [summary for summary in part.summaries[names[7]] if summary is not None]
    assert sum(summary.samples for summary in summaries) == len(rows)


async def test_what_is_too_old_or_ahead_of_time_is_left_out(house: House) -> None:
    kept = {NOW_MS - house.keep.raw_ms: {"a": 1.0}, NOW_MS: {"a": 2.0}, NOW_MS + 60_000: {"a": 3.0}}
    refused = {NOW_MS - house.keep.raw_ms - 1: {"a": 4.0}, NOW_MS + 400_000: {"a": 5.0}, 0: {"a": 6.0}}
    await house.writer.add(PLACE, series.from_rows((kept | refused).items()))
    await assert_whole(house, kept)


async def test_a_device_has_so_many_streams_and_a_stream_so_many_fields(house: House) -> None:
    for number in range(MAX_STREAMS + 1):
        new = await house.writer.add(PLACE._replace(stream=f"s{number}"), series.from_rows([(NOW_MS, {"a": 1.0})]))
        assert len(new) == (number < MAX_STREAMS)
    assert len(await house.reader.streams(ANNA, DEVICE)) == MAX_STREAMS
    many = {NOW_MS + n: {f"f{n}": 1.0} for n in range(2 * series.MAX_FIELDS)}
    await house.writer.add(PLACE._replace(stream="s1"), series.from_rows(many.items()))
    part = await house.read("s1", level="1d")
    assert len(part.summaries) == series.MAX_FIELDS


async def test_a_live_stream_is_written_without_reading_until_somebody_else_writes_it(house: House) -> None:
    rows: dict[int, dict[str, float]] = {}
    reads = 0
    real = house.writer._read

    async def counted(*arguments: Any) -> Any:
        nonlocal reads
        reads += 1
        return await real(*arguments)

    house.writer._read = counted  # type: ignore[assignment, method-assign]
    other = house.instance()[2]

    async def add(writer: SeriesWriter, number: int) -> None:
        new = {house.clock.at_ms + 100 * n: {"a": float(n)} for n in range(number * 50, number * 50 + 50)}
        rows.update(new)
        assert len(await writer.add(PLACE, series.from_rows(new.items()))) == 50

    for number in range(20):
        await add(house.writer, number)
    assert reads == 1
    await add(other, 20)
    await add(house.writer, 21)
    assert reads == 2
    assert len(await house.writer.add(PLACE, series.from_rows(rows.items()))) == 0
    await assert_whole(house, rows)


# ---------------------------------------------------------------- reading


async def test_few_samples_are_given_as_they_are_and_many_in_buckets(house: House) -> None:
    rows = {NOW_MS - 3_600_000 + 1000 * n: {"a": float(n)} for n in range(3600)}
    await house.writer.add(PLACE, series.from_rows(rows.items()))
    few = await house.read(first_ms=NOW_MS - 60_000, last_ms=NOW_MS, points=100)
    assert few.level == RAW
    assert values_of(few, "a") == {at_ms: each["a"] for at_ms, each in rows.items() if at_ms >= NOW_MS - 60_000}
    assert (await house.read(points=500)).level == FINEST
    coarse = await house.read(points=100)
    assert coarse.level.name == "1min"
    assert len(coarse.at_ms) <= 100


async def test_pages_follow_one_another(house: House) -> None:
    rows = {NOW_MS - 3_600_000 + 700 * n: {"a": float(n)} for n in range(5000)}
    await house.writer.add(PLACE, series.from_rows(rows.items()))
    for level in (RAW, FINEST):
        found: list[int] = []
        cursor: str | None = None
        pages = 0
        while True:
            part = await house.read(level=level.name, points=170, cursor=cursor)
            assert 0 < len(part.at_ms) <= 170
            found += part.at_ms
            pages += 1
            cursor = part.cursor
            if cursor is None:
                break
        step = max(1, level.span_ms)
        assert found == sorted({series.floor(at_ms, step) for at_ms in rows})
        assert pages == math.ceil(len(found) / 170)


@pytest.mark.parametrize("wanted", [{"level": "2h"}, {"fields": ["z"]}, {"cursor": "x"}, {"cursor": "raw.1_0"}])
async def test_what_cannot_be_read_is_refused(house: House, wanted: dict[str, Any]) -> None:
    await house.writer.add(PLACE, series.from_rows([(NOW_MS, {"a": 1.0})]))
    with pytest.raises(Problem) as caught:
        await house.read(**wanted)
    assert caught.value.status == 422


@pytest.mark.parametrize("stream", ["other", "", "a/b", "..", "\ud800", "x" * 600])
async def test_a_stream_that_is_not_there_is_unknown(house: House, stream: str) -> None:
    with pytest.raises(Problem) as caught:
        await house.read(stream)
    assert caught.value.code == "stream-unknown"


# ---------------------------------------------------------------- intake


async def test_measurements_of_claimed_devices_are_stored(house: House) -> None:
    rows = {NOW_MS - 100 * n: {"temperature_c.elbow": 40.0 + n, "fan": 1.0} for n in range(50)}
    arrived = [message(at_ms, "health", **values) for at_ms, values in rows.items()]
    await house.intake.ingest(arrived)
    await house.intake.ingest(arrived[10:20])
    await assert_whole(house, rows)
    for shard in range(SHARDS):
        assert not (await house.tables.query(records.DATA, str(shard))).rows
    (seen,) = house.seen
    assert seen[:2] == (DEVICE, "health")
    assert [set(values) for _, values in seen[2]] == [{"temperature_c.elbow", "fan"}] * len(seen[2])
    assert seen[2][-1][0] == NOW_MS


async def test_joints_are_stored_under_their_names(house: House) -> None:
    names = ("shoulder", "élbow", "wrist")
    joint = Joint(
        name="", label="", lower_rad=0, upper_rad=1, max_velocity_rad_s=1, max_acceleration_rad_s2=1,
        max_jerk_rad_s3=1, max_effort_nm=1,
    )  # fmt: skip
    joints = tuple(
        Joint(**{field: getattr(joint, field) for field in joint.__struct_fields__} | {"name": name}) for name in names
    )
    description = Description(device="arm", kind="arm", robot_type="ur5", label="Arm", joints=joints)
    tables: Any = house.tables
    await records.upsert(tables, records.DESCRIPTIONS, AGENT, "arm", lambda _: description, Description)
    telemetry = JointTelemetry(
        tick_ms=1, at_ms=NOW_MS, sequence=1, mode=Mode.STREAMING, position_rad=(0.1, 0.2, 0.3, 0.4),
        velocity_rad_s=(1.0, 2.0, 3.0, 4.0), effort_nm=(5.0,), commanded_rad=(), loop_age_ms=12.0,
    )  # fmt: skip
    await house.intake.ingest(
        [InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "joints"), codec.encode(telemetry))]
    )
    expected = {"loop_age_ms": 12.0, "effort_nm.shoulder": 5.0}
    for index, name in enumerate(("shoulder", "1", "wrist", "3")):
        expected[f"position_rad.{name}"] = (0.1, 0.2, 0.3, 0.4)[index]
        expected[f"velocity_rad_s.{name}"] = index + 1.0
    await assert_whole(house, {NOW_MS: expected}, "joints")


@pytest.mark.parametrize(
    "topic",
    [
        Topic("other", AGENT, "arm", topics.TELE, "health"),
        Topic("space", AGENT, "leg", topics.TELE, "health"),
        Topic("space", "klmnopqrst", "arm", topics.TELE, "health"),
    ],
)
async def test_what_does_not_belong_to_a_claimed_device_is_dropped(house: House, topic: Topic) -> None:
    await house.intake.ingest([InboundMessage(topic, message(NOW_MS, a=1.0).payload)])
    assert await house.reader.streams(ANNA, DEVICE) == []


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        b'{"tick_ms":1,"at_ms":1,"sequence":1,"values":{}}',
        b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{"a":NaN}}',
        b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{"a":1e999}}',
        b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{"a":1e301}}',
        b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{"a b":1}}',
        b'{"tick_ms":1,"at_ms":1800000000000,"sequence":1,"values":{"a":"1"}}',
        b'{"tick_ms":1,"at_ms":-1,"sequence":1,"values":{"a":1}}',
    ],
)
async def test_one_bad_message_does_not_hold_up_the_others(house: House, payload: bytes) -> None:
    bad = InboundMessage(Topic("space", AGENT, "arm", topics.TELE, "health"), payload)
    await house.intake.ingest([bad, message(NOW_MS, a=1.0), bad])
    await assert_whole(house, {NOW_MS: {"a": 1.0}})


async def test_a_new_owner_sees_nothing_of_the_former_one(house: House) -> None:
    await house.intake.ingest([message(NOW_MS, a=1.0)])
    await house.pair(pairing="p2", account="bert")
    bert = Identity("bert", "bert", "s2")
    assert await house.reader.streams(bert, DEVICE) == []
    for who, code in ((bert, "stream-unknown"), (ANNA, "device-unknown")):
        with pytest.raises(Problem) as caught:
            await house.reader.read(who, DEVICE, "health", Range())
        assert caught.value.code == code
    house.clock.at_ms += 10_000
    await house.intake.ingest([message(house.clock.at_ms, b=2.0)])
    part = await house.reader.read(bert, DEVICE, "health", Range(level="raw"))
    assert (part.at_ms, list(part.values)) == ([house.clock.at_ms], ["b"])


async def test_what_was_left_in_the_queue_is_not_the_next_owners(house: House) -> None:
    device = (await house.intake._agent(AGENT)).devices["arm"]
    await house.intake._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])
    await house.pair(pairing="p2", account="bert")
    house.clock.at_ms += LEFT_MS + 1
    for _ in range(SHARDS):
        await house.intake.distribute_backlog()
    assert await _queued(house) == 0
    assert await house.reader.streams(Identity("bert", "bert", "s2"), DEVICE) == []


async def test_an_observer_that_fails_holds_nothing_up(house: House) -> None:
    async def fail(*_: Any) -> None:
        raise RuntimeError("no")

    house.intake._observers = (fail, house.observe)
    await house.intake.ingest([message(NOW_MS, a=1.0)])
    assert len(house.seen) == 1


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
async def test_a_kill_between_any_two_writes_loses_and_doubles_nothing(house: House, after: bool) -> None:
    kills = 0
    for number in range(10):
        stream = f"s{number}"
        rows = {house.clock.at_ms - 3_000 * n: {"a": float(n)} for n in range(10)}
        house.tables.left, house.tables.after = number, after
        try:
            await house.intake.ingest([message(at_ms, stream, **values) for at_ms, values in rows.items()])
        except Killed:
            kills += 1
        house.tables.left = None
        if number == 0 and not after:
            continue  # nothing was written at all: the broker, or who called, has it still
        house.clock.at_ms += LEFT_MS + 1
        _, intake, _, _ = house.instance()
        for _ in range(SHARDS):
            await intake.distribute_backlog()
        assert await _queued(house) == 0
        await assert_whole(house, rows, stream)
    assert kills > 5


async def _queued(house: House) -> int:
    return sum([len((await house.tables.query(records.DATA, str(shard))).rows) for shard in range(SHARDS)])


async def test_what_can_never_be_distributed_is_given_up(house: House) -> None:
    await house.intake.ingest([])
    _, intake, _, _ = house.instance()
    device = (await intake._agent(AGENT)).devices["arm"]
    await intake._queue([_Part(device, "health", series.from_rows([(NOW_MS, {"a": 1.0})]))])

    async def busy(*_: Any) -> Samples:
        raise Problem("busy", 503, "Busy", "Try again.")

    intake._writer.add = busy  # type: ignore[assignment, method-assign]
    for later_ms, left in ((LEFT_MS + 1, 1), (GIVE_UP_MS + 1, 0)):
        house.clock.at_ms = NOW_MS + later_ms
        for _ in range(SHARDS):
            await intake.distribute_backlog()
        assert await _queued(house) == left


async def test_a_store_that_is_away_is_said(house: House) -> None:
    house.tables.left, house.tables.error = 1, StoreError("away")
    with pytest.raises(StoreError):
        await house.intake.ingest([message(NOW_MS, a=1.0)])
    house.tables.left = None
    await house.intake.ingest([message(NOW_MS, a=1.0)])
    await assert_whole(house, {NOW_MS: {"a": 1.0}})


# ---------------------------------------------------------------- forgetting


async def test_each_level_is_kept_as_long_as_it_is_said(house: House) -> None:
    day_ms = DAY.span_ms
    house.keep = RetentionPolicy(raw_ms=day_ms, levels_ms={"10s": 2 * day_ms, "1min": 3 * day_ms, "10min": 5 * day_ms})
    reader, _, writer, forget = house.instance()
    rows = {NOW_MS - 1000 * n: {"a": float(n)} for n in range(500)}
    await writer.add(PLACE, series.from_rows(rows.items()))
    end_ms = series.floor(NOW_MS, day_ms) + day_ms
    gone = {"raw": 1, "10s": 2, "1min": 3, "10min": 5}
    for days in range(8):
        house.clock.at_ms = end_ms + days * day_ms + 2 * 3_600_000
        for _ in range(5):
            await forget.delete_due(house.clock.at_ms)
        for level in (RAW, *LEVELS):
            part = await reader.read(ANNA, DEVICE, "health", Range(level=level.name, points=1000))
            assert bool(part.at_ms) == (days < gone.get(level.name, 1000)), (level, days)
    part = await reader.read(ANNA, DEVICE, "health", Range())
    assert part.level.name == "1h"
    assert sum(summary.samples for summary in part.summaries["a"] if summary) == 500


async def test_no_row_is_written_that_will_not_be_forgotten(house: House) -> None:
    """Every raw row lies in a range that a note names."""
    chance = random.Random(9)  # noqa: S311 (the same each time)
    rows = some_rows(chance, 300, span_ms=house.keep.raw_ms)
    await house.writer.add(PLACE, series.from_rows(rows.items()))
    notes: list[Row] = []
    for shard in range(8):
        notes += (await house.tables.query(records.FORGET, str(shard), limit=1000)).rows
    ranges = [(note.data["first"], note.data["last"]) for note in notes]
    assert len(ranges) == 2 * 4  # two days, four levels that end
    page = await house.tables.query(records.SERIES, PLACE.partition, limit=1000)
    for row in page.rows:
        kept = row.key == ABOUT or row.key.startswith(("1h:", "6h:", "1d:"))
        assert any(first <= row.key < last for first, last in ranges) != kept, row.key
