"""Heartbeats, and the parts that the health check derives from them."""

import asyncio
import os
from dataclasses import replace
from typing import Any

import pytest

from device_agent.protocol import Presence, codec, topics
from function_app.domain.health.server_health import Status
from function_app.ports.tables import StoreError
from function_app.services.maintenance.heartbeats import FORGET_MS, Heartbeat, age_of
from function_app.services.storage import records
from function_app.settings import Administration
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, problem

TOKEN = "a-token-of-the-monitoring"  # pragma: allowlist secret
ADMINISTRATION = Administration(accounts=frozenset({"anna"}), metrics_token=TOKEN)
BEAT = Heartbeat(
    name="other-1", host="other", process=1, version="1", started_ms=0, seen_ms=0, period_ms=1000, timers={"jobs": 0}
)


@pytest.fixture
def cloud(open_cloud: OpenCloud) -> Cloud:
    cloud = open_cloud(administration=ADMINISTRATION)
    cloud.start_ingest()
    return cloud


def parts(cloud: Cloud) -> dict[str, dict[str, Any]]:
    cloud.clock.advance(1)
    answer = cloud.request("GET", f"{API}/health/ready", headers={"Authorization": f"Bearer {TOKEN}"})
    return {part["name"]: part for part in answer.json()["parts"]}


def run_worker(cloud: Cloud, seconds: int = 1) -> None:
    for _ in range(seconds):
        cloud.functions.heartbeats.ran("jobs")
        cloud.run(cloud.functions.heartbeats.beat(cloud.functions.heartbeats.name, period_ms=1000))
        parts(cloud)


def test_without_a_worker_nothing_that_depends_on_one_is_ok(cloud: Cloud) -> None:
    found = parts(cloud)
    assert {name for name, part in found.items() if part["status"] == "failed"} == {"workers", "timers", "ingest"}
    assert all("Start `telescope-server work`" in found[name]["message"] for name in ("workers", "timers", "ingest"))
    assert cloud.request("GET", f"{API}/health").json()["status"] == "degraded"


def test_with_a_worker_all_parts_are_ok(cloud: Cloud) -> None:
    run_worker(cloud, 3)
    assert {name: part["status"] for name, part in parts(cloud).items()} == dict.fromkeys(
        ("tables", "blobs", "broker", "models", "workers", "disk", "timers", "ingest"), "ok"
    )


def test_a_part_keeps_the_time_at_which_its_status_began(cloud: Cloud) -> None:
    first = parts(cloud)["workers"]["since"]
    assert parts(cloud)["workers"]["since"] == first
    run_worker(cloud)
    assert parts(cloud)["workers"]["since"] > first


def test_a_message_that_no_worker_stores_is_lag(cloud: Cloud) -> None:
    run_worker(cloud, 2)
    cloud.functions.heartbeats._ingested.clear()
    cloud.functions.heartbeats.observe = lambda *_: True  # type: ignore[method-assign]
    run_worker(cloud, 3)
    assert parts(cloud)["ingest"]["status"] == "degraded"
    run_worker(cloud, 3)
    found = parts(cloud)
    assert (found["ingest"]["status"], found["workers"]["status"]) == ("failed", "ok")


def test_a_broker_that_cannot_be_reached_is_failed(cloud: Cloud) -> None:
    run_worker(cloud)
    assert cloud.memory is not None
    cloud.memory.broker.reachable = False
    assert parts(cloud)["broker"]["status"] == "failed"
    cloud.memory.broker.reachable = True
    assert parts(cloud)["broker"]["status"] == "ok"


def test_without_readable_tables_nothing_is_said_about_workers(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fail(*_: object) -> None:
        raise StoreError("the disk is broken.")

    monkeypatch.setattr(cloud.functions.heartbeats, "all", fail)
    found = parts(cloud)
    assert found["workers"]["message"] == "the disk is broken."
    for name in ("timers", "ingest"):
        assert (found[name]["status"], "cannot be read" in found[name]["message"]) == ("failed", True)


@pytest.mark.parametrize(("store", "call"), [("tables", "check"), ("tables", "create"), ("blobs", "put")])
def test_a_store_that_cannot_be_written_is_failed(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, store: str, call: str
) -> None:
    async def fail(*_: object) -> None:
        raise StoreError("the disk is full. Free disk space.")

    monkeypatch.setattr(getattr(cloud.functions, store), call, fail)
    assert (parts(cloud)[store]["status"], parts(cloud)[store]["message"]) == (
        "failed",
        "the disk is full. Free disk space.",
    )


@pytest.mark.parametrize("error", [RuntimeError("unforeseen"), TimeoutError()])
def test_a_check_that_raises_is_a_failed_part(cloud: Cloud, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    async def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(cloud.functions.blobs, "put", fail)
    assert parts(cloud)["blobs"]["status"] == "failed"


def test_a_store_that_changes_content_is_failed(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    async def other(*_: object) -> bytes:
        return b"other"

    monkeypatch.setattr(cloud.functions.blobs, "get", other)
    assert parts(cloud)["blobs"]["status"] == "failed"


def test_a_check_is_made_once_per_second(cloud: Cloud) -> None:
    async def measure() -> list[bool]:
        first = await cloud.functions.health.check()
        return [await each is first for each in (cloud.functions.health.check(), cloud.functions.health.check())]

    assert cloud.run(measure()) == [True, True]
    cloud.clock.advance(1)
    assert cloud.run(measure()) == [True, True]


def test_one_of_two_workers_that_stops_degrades_the_server(cloud: Cloud) -> None:
    run_worker(cloud, 2)
    store(cloud, BEAT, age_ms=6_000)
    run_worker(cloud)
    found = parts(cloud)
    assert (found["workers"]["status"], found["timers"]["status"]) == ("degraded", "ok")
    assert "other-1: last run" in found["workers"]["message"]


def test_the_row_of_a_worker_that_ended_long_ago_is_deleted(cloud: Cloud) -> None:
    store(cloud, BEAT, age_ms=FORGET_MS + 1_000)
    assert cloud.run(cloud.functions.heartbeats.all()) == []


def test_a_worker_deletes_rows_of_ended_processes_of_its_machine_and_its_own_at_the_end(cloud: Cloud) -> None:
    beats = cloud.functions.heartbeats
    store(cloud, replace(BEAT, name="ended", host=beats.host, process=2**22 + 1), age_ms=0)
    store(cloud, replace(BEAT, name="parent", host=beats.host, process=os.getppid()), age_ms=0)
    store(cloud, BEAT, age_ms=0)

    async def run() -> list[str]:
        task = asyncio.ensure_future(beats.run())
        await asyncio.sleep(2)
        found = [beat.name for beat in await beats.all()]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return found

    assert set(cloud.run(run())) == {"parent", "other-1", beats.name}
    assert {beat.name for beat in cloud.run(beats.all())} == {"parent", "other-1"}


def test_a_heartbeat_that_cannot_be_stored_is_logged_once_and_repeated(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(*_: object) -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(cloud.functions.tables, "create", fail)

        async def run() -> None:
            task = asyncio.ensure_future(cloud.functions.heartbeats.run())
            await asyncio.sleep(5)
            patch.undo()
            await asyncio.sleep(2)
            assert len(await cloud.functions.heartbeats.all()) == 1
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        cloud.run(run())
    assert [record.message for record in caplog.records].count("heartbeat: the disk is full") == 1


@pytest.mark.parametrize(
    ("age_ms", "period_ms", "expected"),
    [
        (1_000, 1_000, Status.OK),
        (3_100, 1_000, Status.DEGRADED),
        (5_100, 1_000, Status.FAILED),
        (-5_100, 1_000, Status.FAILED),
        (140_000, 60_000, Status.OK),
        (160_000, 60_000, Status.FAILED),
    ],
)
def test_a_heartbeat_is_in_time_within_its_period(age_ms: int, period_ms: int, expected: Status) -> None:
    found = age_of("w", 1_000_000, 1_000_000 + age_ms, period_ms)
    assert found.status is expected
    assert ("Synchronise the clocks" in found.message) == (age_ms < 0)


def test_the_timer_of_a_cloud_host_writes_a_heartbeat(cloud: Cloud) -> None:
    cloud.run(cloud.functions.heartbeats.timer_ran(period_ms=60_000))
    cloud.clock.advance(120)
    assert (parts(cloud)["workers"]["status"], parts(cloud)["timers"]["status"]) == ("ok", "ok")
    cloud.clock.advance(60)
    assert (parts(cloud)["workers"]["status"], parts(cloud)["timers"]["status"]) == ("failed", "failed")


def test_connected_agents_and_devices_are_counted(cloud: Cloud) -> None:
    beats = cloud.functions.heartbeats
    online, offline = (codec.encode(Presence(online=online, session=1, at_ms=1)) for online in (True, False))
    beats.observe(topics.parse("ts/v1/s/a/conn"), online)
    beats.observe(topics.parse("ts/v1/s/a/arm/state"), b"")
    beats.observe(topics.parse("ts/v1/s/b/arm/state"), b"")
    run_worker(cloud)
    (beat,) = cloud.run(beats.all())
    assert (beat.agents_online, beat.devices_online) == (1, 1)
    beats.observe(topics.parse("ts/v1/s/a/conn"), offline)
    run_worker(cloud)
    (beat,) = cloud.run(beats.all())
    assert (beat.agents_online, beat.devices_online) == (0, 0)


class TestAccess:
    def test_administrators_and_the_token_see_the_parts(self, cloud: Cloud) -> None:
        anna, bert = cloud.sign_in("Anna"), cloud.sign_in("bert")
        for path in ("/health", "/health/ready"):
            cloud.clock.advance(1)
            assert anna.get(path).json()["parts"]
            assert not bert.get(path).json().get("parts")
            for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Bearer ts_wrong"}):
                assert not cloud.request("GET", API + path, headers=headers).json().get("parts")

    def test_an_api_key_of_an_administrator_sees_the_status(self, cloud: Cloud) -> None:
        key = cloud.sign_in("anna").post("/api-keys", {"name": "k", "role": "operator", "days": 1}).json()["token"]
        answer = cloud.request("GET", f"{API}/health", headers={"Authorization": f"Bearer {key}"})
        assert answer.json()["parts"] is None

    def test_readiness_without_rights_is_a_problem_without_parts(self, cloud: Cloud) -> None:
        body = problem(cloud.request("GET", f"{API}/health/ready"), 503, "not-ready")
        assert "parts" not in body
        assert "worker" not in body["detail"]

    def test_users_read_why_the_broker_fails_and_others_do_not(self, cloud: Cloud) -> None:
        bert = cloud.sign_in("bert")
        assert cloud.memory is not None
        cloud.memory.broker.reachable = False
        cloud.clock.advance(1)
        assert "127.0.0.1" in bert.get("/health").json()["broker"]
        assert cloud.request("GET", f"{API}/health").json()["broker"] == "failed"

    def test_liveness_needs_no_store(self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cloud.functions, "tables", None)
        assert cloud.request("GET", f"{API}/health/live").json() == {"status": "ok"}


def store(cloud: Cloud, beat: Heartbeat, *, age_ms: int) -> None:
    now_ms = cloud.clock.now_ms() - age_ms
    beat = replace(beat, seen_ms=now_ms, timers={"jobs": now_ms})
    cloud.run(records.upsert(cloud.functions.tables, records.WORKERS, "workers", beat.name, lambda _: beat, Heartbeat))
