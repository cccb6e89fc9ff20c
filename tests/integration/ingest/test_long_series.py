"""A query over a month of measurements reads few rows and returns one page."""

import asyncio
import json
import math
import random
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from function_app import settings
from function_app.domain.devices.devices import Agent
from function_app.domain.telemetry.series import DAY, WINDOW_MS, Samples
from function_app.ports.tables import Page, Tables
from function_app.services.storage import records
from function_app.services.telemetry.series_writer import Place as Target
from function_app.settings import RateLimits
from tests.harness.cloud.cloud import Cloud
from tests.harness.processes import Place

PERIOD_MS = 50
PER_WINDOW = WINDOW_MS // PERIOD_MS
WINDOWS = 30
"""Windows in one batch: five minutes, as from a robot that was offline."""
HOUR_MS = 3_600_000


class CountingTables:
    """Tables that count the rows read."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.queries = self.rows = self.bytes = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._tables, name)

    async def query(self, *arguments: Any, **options: Any) -> Page:
        page = await self._tables.query(*arguments, **options)
        self.queries += 1
        self.rows += len(page.rows)
        self.bytes += sum(len(json.dumps(row.data)) for row in page.rows)
        return page


@dataclass(slots=True)
class Expected:
    """Statistics of one hour, computed from the measured values."""

    count: int = 0
    sums: list[float] = field(default_factory=list)
    low: float = math.inf
    high: float = -math.inf
    last: float = math.nan

    def add(self, values: "array[float]") -> None:
        self.count += len(values)
        self.sums.append(math.fsum(values))
        self.low = min(self.low, *values)
        self.high = max(self.high, *values)
        self.last = values[-1]


def measured(begin_ms: int, windows: int, rng: random.Random) -> Iterator[tuple[int, Samples]]:
    """Windows of a slow random walk of a joint at 20 Hz, each with its start time."""
    swing = [math.sin(number * math.tau / PER_WINDOW) for number in range(PER_WINDOW)]
    level = 0.0
    for first in range(0, windows, WINDOWS):
        start_ms = begin_ms + first * WINDOW_MS
        count = min(WINDOWS, windows - first) * PER_WINDOW
        values = array("d")
        for _ in range(count // PER_WINDOW):
            level += rng.uniform(-0.01, 0.01)
            values.extend([level + each for each in swing])
        yield start_ms, Samples(array("q", range(start_ms, start_ms + count * PERIOD_MS, PERIOD_MS)), {"a": values})


def build(cloud: Cloud, target: Target, days: float) -> dict[int, Expected]:
    """Write measurements of ``days`` through the service; returns the statistics of each hour."""
    writer = cloud.functions.telemetry_ingest._writer
    begin_ms = cloud.clock.now_ms() // DAY.span_ms * DAY.span_ms - 40 * DAY.span_ms
    hours: dict[int, Expected] = {}

    async def write() -> None:
        for start_ms, samples in measured(begin_ms, round(days * DAY.span_ms / WINDOW_MS), random.Random(1)):  # noqa: S311
            cloud.clock.ahead_ms += start_ms + WINDOWS * WINDOW_MS - cloud.clock.now_ms()
            await writer.add(target, samples)
            hours.setdefault(start_ms // HOUR_MS * HOUR_MS, Expected()).add(samples.columns["a"])

    asyncio.run_coroutine_threadsafe(write(), cloud.loop).result(1_500)
    return hours


def check_one_page(cloud: Cloud, days: float) -> None:
    anna = cloud.sign_in("anna")
    robot = cloud.robot()
    robot.pair(anna)
    agent = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert agent is not None
    target = Target(robot.device, records.read(agent, Agent).pairing, "health")
    hours = build(cloud, target, days)
    anna = cloud.sign_in("anna")
    tables = CountingTables(cloud.functions.tables)
    cloud.functions.series._tables = tables

    # For a month, a page has room for hours at most; a shorter query requests hours.
    query = {"points": 1000} if days > 7 else {"points": 1000, "resolution": "1h"}
    answer = anna.get(f"/devices/{robot.device}/data/health", params=query)
    page = answer.json()
    assert (page["resolution"], page["cursor"]) == ("1h", None)
    assert page["at_ms"] == sorted(hours)
    column = page["fields"]["a"]
    for index, at_ms in enumerate(page["at_ms"]):
        expected = hours[at_ms]
        assert column["count"][index] == expected.count
        assert (column["min"][index], column["max"][index]) == (expected.low, expected.high)
        assert column["last"][index] == expected.last
        assert column["mean"][index] == pytest.approx(math.fsum(expected.sums) / expected.count, rel=1e-9, abs=1e-12)
    assert sum(column["count"]) == round(days * DAY.span_ms / PERIOD_MS)
    assert tables.queries == 1
    assert tables.rows == len(hours) <= 1000
    assert tables.bytes < 1_000_000
    assert len(answer.content) < 200_000


@pytest.mark.parametrize(
    ("place", "days"),
    [
        ("local", 1 / 12),
        *(
            pytest.param(store, days, marks=[pytest.mark.long, pytest.mark.timeout(1800)])
            for store, days in (("local", 30), ("azure", 1), ("aws", 1 / 48))  # a day took 24 GB with moto
        ),
    ],
    indirect=["place"],
)
def test_a_month_at_20_hz_fits_into_one_page(place: Place, days: float) -> None:
    unlimited = RateLimits(address=0, account=0, key=0, agent=0)
    with Cloud(replace(settings.read(place.environment), rate_limits=unlimited)) as cloud:
        check_one_page(cloud, days)
