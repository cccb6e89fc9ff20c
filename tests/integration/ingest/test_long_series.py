"""A month of a robot's measurements answers a question in one page, and little is read for it."""

import asyncio
import contextlib
import json
import math
import random
import secrets
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from function_app import bootstrap
from function_app.adapters.aws.blobs import S3Blobs
from function_app.adapters.aws.tables import DynamoTables
from function_app.domain.devices.devices import Agent
from function_app.domain.telemetry.series import DAY, WINDOW_MS, Samples
from function_app.ports.tables import Page, Tables
from function_app.services.storage import records
from function_app.services.telemetry.series_writer import Place
from function_app.settings import AwsStore, AzureStore, Settings
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.stores.aws import REGION, start_moto, use_credentials
from tests.harness.stores.azure import start_azurite

PERIOD_MS = 50
PER_WINDOW = WINDOW_MS // PERIOD_MS
WINDOWS = 30
"""Windows that are handed over at once: five minutes, as a robot that was off line does."""
HOUR_MS = 3_600_000


class Counting:
    """Tables that count what is read."""

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
class Truth:
    """What was measured in one hour, computed from the values themselves."""

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


def measured(begin_ms: int, windows: int, chance: random.Random) -> Iterator[tuple[int, Samples]]:
    """Stretches of a slowly wandering joint at 20 Hz, each with its beginning."""
    swing = [math.sin(number * math.tau / PER_WINDOW) for number in range(PER_WINDOW)]
    level = 0.0
    for first in range(0, windows, WINDOWS):
        start_ms = begin_ms + first * WINDOW_MS
        count = min(WINDOWS, windows - first) * PER_WINDOW
        values = array("d")
        for _ in range(count // PER_WINDOW):
            level += chance.uniform(-0.01, 0.01)
            values.extend([level + each for each in swing])
        yield start_ms, Samples(array("q", range(start_ms, start_ms + count * PERIOD_MS, PERIOD_MS)), {"a": values})


def build(cloud: Cloud, place: Place, days: float) -> dict[int, Truth]:
    """Write ``days`` through the service, as time passes; the hours as they were."""
    writer = cloud.functions.telemetry_ingest._writer
    begin_ms = cloud.clock.now_ms() // DAY.span_ms * DAY.span_ms - 40 * DAY.span_ms
    hours: dict[int, Truth] = {}

    async def write() -> None:
        for start_ms, samples in measured(begin_ms, round(days * DAY.span_ms / WINDOW_MS), random.Random(1)):  # noqa: S311
            cloud.clock.ahead_ms += start_ms + WINDOWS * WINDOW_MS - cloud.clock.now_ms()
            await writer.add(place, samples)
            hours.setdefault(start_ms // HOUR_MS * HOUR_MS, Truth()).add(samples.columns["a"])

    asyncio.run_coroutine_threadsafe(write(), cloud.loop).result(1_500)
    return hours


def assert_read_in_one_page(cloud: Cloud, days: float) -> None:
    anna = cloud.sign_in("anna")
    robot = cloud.robot()
    robot.pair(anna)
    agent = cloud.run(cloud.functions.tables.get(records.AGENTS, robot.id, "agent"))
    assert agent is not None
    place = Place(robot.device, records.read(agent, Agent).pairing, "health")
    hours = build(cloud, place, days)
    anna = cloud.sign_in("anna")
    tables = Counting(cloud.functions.tables)
    cloud.functions.series._tables = tables

    # Of a month hours are the finest that a page has room for; of a shorter time they are asked for.
    asked = {"points": 1000} if days > 7 else {"points": 1000, "resolution": "1h"}
    answer = anna.get(f"/devices/{robot.device}/data/health", params=asked)
    page = answer.json()
    assert (page["resolution"], page["cursor"]) == ("1h", None)
    assert page["at_ms"] == sorted(hours)
    column = page["fields"]["a"]
    for index, at_ms in enumerate(page["at_ms"]):
        truth = hours[at_ms]
        assert column["count"][index] == truth.count
        assert (column["min"][index], column["max"][index]) == (truth.low, truth.high)
        assert column["last"][index] == truth.last
        assert column["mean"][index] == pytest.approx(math.fsum(truth.sums) / truth.count, rel=1e-9, abs=1e-12)
    assert sum(column["count"]) == round(days * DAY.span_ms / PERIOD_MS)
    assert tables.queries == 1
    assert tables.rows == len(hours) <= 1000
    assert tables.bytes < 1_000_000
    assert len(answer.content) < 200_000


@pytest.mark.parametrize("days", [1 / 4, pytest.param(30, marks=[pytest.mark.long, pytest.mark.timeout(1800)])])
def test_a_month_at_20_hz_answers_in_one_page(tmp_path: Path, days: float) -> None:
    with Cloud(settings(tmp_path / "home")) as cloud:
        assert_read_in_one_page(cloud, days)


@pytest.fixture
def chosen(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Settings]:
    """Settings of an empty store of a cloud's."""
    name = f"test{secrets.token_hex(8)}"
    known = settings(tmp_path / "home")
    with contextlib.ExitStack() as stack:
        if request.param == "azure":
            connection = stack.enter_context(start_azurite())
            yield replace(known, store=AzureStore(connection=connection, prefix=name, container=name))
            return
        use_credentials(monkeypatch)
        endpoint = stack.enter_context(start_moto())
        chosen = replace(known, store=AwsStore(region=REGION, bucket=name, table=name, endpoint=endpoint))
        asyncio.run(_prepare(chosen))
        yield chosen


async def _prepare(chosen: Settings) -> None:
    functions = bootstrap.build(chosen)
    assert isinstance(functions.tables, DynamoTables)
    assert isinstance(functions.blobs, S3Blobs)
    await functions.tables.prepare()
    await functions.blobs.prepare()
    await functions.close()


# A day over moto, which keeps all in memory, took 24 GB and did not end.
@pytest.mark.parametrize(
    ("chosen", "days"),
    [
        ("azure", 1 / 48),
        ("aws", 1 / 48),
        pytest.param("azure", 1, marks=[pytest.mark.long, pytest.mark.timeout(1800)]),
    ],
    indirect=["chosen"],
)
def test_the_clouds_stores_answer_alike(chosen: Settings, days: float) -> None:
    with Cloud(chosen) as cloud:
        assert_read_in_one_page(cloud, days)
