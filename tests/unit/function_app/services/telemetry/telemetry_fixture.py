"""A claimed device with its series, over tables that can fail."""

import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import Measurements, codec, topics
from device_agent.protocol.topics import Topic
from function_app.adapters.local.tables import SqliteTables
from function_app.domain.devices.devices import Agent, Device, DeviceSpec
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry import series
from function_app.domain.telemetry.series import LEVELS, RetentionPolicy
from function_app.services.devices.device_access import DeviceAccess
from function_app.services.storage import records
from function_app.services.storage.retention import Retention
from function_app.services.telemetry.ingest import InboundMessage, TelemetryIngest, Values
from function_app.services.telemetry.series_reader import Part, Range, SeriesReader
from function_app.services.telemetry.series_writer import Place, SeriesWriter
from tests.fakes.blobs import MemoryBlobs
from tests.harness.crash_injection import CrashPoint, crashing_tables

AGENT = "abcdefghij"
DEVICE = f"{AGENT}-arm"
ANNA = Identity("anna", "anna", "s1")
PLACE = Place(DEVICE, "p1", "health")
NOW_MS = 1_800_000_000_000
"""A time that is not the beginning of a day."""


class Clock:
    def __init__(self) -> None:
        self.at_ms = NOW_MS

    def now_ms(self) -> int:
        return self.at_ms


class TelemetrySetup:
    """The telemetry services with SQLite tables, and an agent of Anna with one arm."""

    def __init__(self, folder: Path) -> None:
        self.clock = Clock()
        self.keep = RetentionPolicy()
        self.crash = CrashPoint()
        self.tables: Any = crashing_tables(SqliteTables(folder / "tables.sqlite"), self.crash)
        self.observed: list[tuple[str, str, Sequence[tuple[int, Values]]]] = []
        self.reader, self.ingest, self.writer, self.retention = self.instance()

    def instance(self) -> tuple[SeriesReader, TelemetryIngest, SeriesWriter, Retention]:
        stores: dict[str, Any] = {"tables": self.tables, "clock": self.clock}
        retention = Retention(tables=self.tables, blobs=MemoryBlobs(now_s=lambda: 0.0))
        writer = SeriesWriter(retention=retention, keep=self.keep, **stores)
        ingest = TelemetryIngest(writer=writer, observers=[self.observe], **stores)
        return SeriesReader(devices=DeviceAccess(**stores), keep=self.keep, **stores), ingest, writer, retention

    async def observe(self, device: Device, stream: str, means: Sequence[tuple[int, Values]]) -> None:
        self.observed.append((device.id, stream, means))

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

    async def read(self, stream: str = "health", **options: Any) -> Part:
        return await self.reader.read(ANNA, DEVICE, stream, Range(**options))


def message(at_ms: int, stream: str = "health", /, **values: float) -> InboundMessage:
    body = Measurements(tick_ms=at_ms, at_ms=at_ms, sequence=0, values=dict(values))
    return InboundMessage(Topic("space", AGENT, "arm", topics.TELE, stream), codec.encode(body))


async def assert_whole(setup: TelemetrySetup, rows: dict[int, dict[str, float]], stream: str = "health") -> None:
    """Check that every level of the series contains exactly these samples."""
    (view,) = [view for view in await setup.reader.streams(ANNA, DEVICE) if view.name == stream]
    assert view.about.count == len(rows)
    assert (view.about.first_ms, view.about.last_ms) == (min(rows), max(rows))
    names = {name for values in rows.values() for name in values}
    assert set(view.about.fields) == names
    stored: dict[int, dict[str, float]] = {}
    cursor: str | None = None
    while True:
        part = await setup.read(stream, level="raw", points=1000, cursor=cursor)
        for index, at_ms in enumerate(part.at_ms):
            assert at_ms not in stored
            stored[at_ms] = {name: value for name in names if (value := part.values[name][index]) is not None}
        cursor = part.cursor
        if cursor is None:
            break
    assert stored == rows
    for level in LEVELS:
        part = await setup.read(stream, level=level.name, points=1000)
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
