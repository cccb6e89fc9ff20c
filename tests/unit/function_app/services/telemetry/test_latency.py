"""The latency store counts each batch once and computes percentiles per device, transport and path."""

import math
import random
from typing import Any

import pytest

from device_agent.protocol import Ack, AckStatus, codec, topics
from function_app.domain.actions.action import Action
from function_app.domain.identity.accounts import Identity
from function_app.domain.telemetry.histogram import ERROR
from function_app.entrypoints.ingest.router import ingest
from function_app.services.actions.acks import ActionAcks
from function_app.services.actions.action_store import StoredAction
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS
from function_app.services.telemetry.latency import HOUR_MS, KEEP_HOURS_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem

Pair = tuple[Person, Robot]
Samples = list[tuple[int, float]]


def body(samples: Samples, **changes: Any) -> dict[str, Any]:
    series = [{"at_ms": at_ms, "ms": ms} for at_ms, ms in samples]
    return {"transport": "mqtt", "path": "operator-device", "samples": series, **changes}


def random_samples(cloud: Cloud, count: int, *, seed: int = 1, over_ms: int = 60_000) -> Samples:
    chance = random.Random(seed)  # noqa: S311 (repeatable samples)
    now_ms = cloud.clock.now_ms()
    moments = sorted(now_ms - chance.randrange(over_ms) for _ in range(count))
    return sorted((at_ms, round(chance.lognormvariate(3.5, 0.6), 3)) for at_ms in moments)


def latencies(person: Person, device: str, **query: Any) -> list[dict[str, Any]]:
    answer = person.get(f"/devices/{device}/latency", params=query)
    assert answer.status_code == 200, answer.text
    items: list[dict[str, Any]] = answer.json()["items"]
    return items


def test_percentiles_bins_and_newest_samples_match_the_samples(cloud: Cloud, anna: Person, robot: Robot) -> None:
    samples = random_samples(cloud, 1700)
    for part in (samples[:600], samples[600:1100], samples[1100:]):
        assert anna.post(f"/devices/{robot.device}/latency", body(part)).status_code == 204
    (series,) = latencies(anna, robot.device)
    times = sorted(ms for _, ms in samples)
    assert series["count"] == len(times)
    assert series["mean_ms"] == pytest.approx(math.fsum(times) / len(times))
    assert (series["min_ms"], series["max_ms"]) == (times[0], times[-1])
    for percent in (50, 90, 95, 99):
        exact = times[math.ceil(percent / 100 * len(times)) - 1]
        assert series[f"p{percent}_ms"] == pytest.approx(exact, rel=ERROR * 1.000001), percent
    for one in series["bins"]:
        assert one["count"] == sum(one["above_ms"] < ms <= one["up_to_ms"] for ms in times)
    assert list(zip(series["at_ms"], series["ms"], strict=True)) == samples[-1000:]
    (few,) = latencies(anna, robot.device, samples=5)
    assert few["ms"] == series["ms"][-5:]
    (none,) = latencies(anna, robot.device, samples=0)
    assert none["ms"] == []


def test_transports_and_paths_are_stored_separately(cloud: Cloud, anna: Person, robot: Robot) -> None:
    now_ms = cloud.clock.now_ms()
    anna.post(f"/devices/{robot.device}/latency", body([(now_ms, 20.0)]))
    anna.post(f"/devices/{robot.device}/latency", body([(now_ms, 300.0)], transport="http-poll"))
    sample = {"device": "arm", **body([(now_ms, 8.0)], path="device-cloud")}
    assert robot.request("POST", f"/agents/{robot.id}/latency", json=sample).status_code == 204
    series = {(item["transport"], item["path"]): item["p50_ms"] for item in latencies(anna, robot.device)}
    assert series == {
        ("http-poll", "operator-device"): pytest.approx(300, rel=ERROR),
        ("mqtt", "device-cloud"): pytest.approx(8, rel=ERROR),
        ("mqtt", "operator-device"): pytest.approx(20, rel=ERROR),
    }
    problem(
        robot.request("POST", f"/agents/{robot.id}/latency", json={**sample, "device": "leg"}), 404, "device-unknown"
    )
    assert len(latencies(anna, robot.device, transport="mqtt", path="device-cloud")) == 1
    assert latencies(anna, robot.device, transport="xmpp") == []


def test_short_spans_are_summed_from_hours_and_long_ones_from_days(cloud: Cloud, anna: Person, robot: Robot) -> None:
    now_ms = cloud.clock.now_ms()
    spread = [(now_ms - hour * HOUR_MS, 10.0 + hour) for hour in range(165)]
    assert anna.post(f"/devices/{robot.device}/latency", body(spread)).status_code == 204
    (whole,) = latencies(anna, robot.device, **{"from": now_ms - 8 * DAY_MS, "to": now_ms + HOUR_MS})
    assert (whole["count"], whole["min_ms"], whole["max_ms"]) == (165, 10.0, 174.0)
    (some,) = latencies(anna, robot.device, **{"from": now_ms - 4 * HOUR_MS, "to": now_ms})
    assert some["count"] == 5
    (days,) = latencies(anna, robot.device, **{"from": now_ms - 300 * DAY_MS, "to": now_ms})
    assert days["count"] == 165
    (before,) = latencies(anna, robot.device, **{"from": now_ms - 30 * DAY_MS, "to": now_ms - 20 * DAY_MS})
    assert (before["count"], before["p50_ms"], before["bins"]) == (0, None, [])


def test_a_repeated_batch_is_counted_once(cloud: Cloud, anna: Person, robot: Robot) -> None:
    path = f"/devices/{robot.device}/latency"
    samples = random_samples(cloud, 50)
    calls = [anna.begin("POST", path, json=body(samples)) for _ in range(6)]
    assert {finish().status_code for finish in calls} == {204}
    assert latencies(anna, robot.device)[0]["count"] == 50
    key = {"Idempotency-Key": "k"}
    other = random_samples(cloud, 7, seed=2)
    for _ in range(3):
        assert anna.post(path, body(other), headers=key).status_code == 204
    assert latencies(anna, robot.device)[0]["count"] == 57
    problem(anna.post(path, body(random_samples(cloud, 7, seed=3)), headers=key), 422, "idempotency-key-reused")


def test_concurrent_batches_are_all_counted(cloud: Cloud, anna: Person, robot: Robot) -> None:
    waiting = [
        anna.begin("POST", f"/devices/{robot.device}/latency", json=body(random_samples(cloud, 20, seed=seed)))
        for seed in range(8)
    ]
    codes = [wait().status_code for wait in waiting]
    (series,) = latencies(anna, robot.device)
    assert set(codes) <= {204, 503}
    assert series["count"] == 20 * codes.count(204) == len(series["ms"])


def test_invalid_samples_are_refused(cloud: Cloud, anna: Person, robot: Robot) -> None:
    path = f"/devices/{robot.device}/latency"
    now_ms = cloud.clock.now_ms()
    wrong: tuple[Samples, ...] = ([], [(now_ms, -1.0)], [(now_ms, 1e9)], [(now_ms, 1.0)] * 1001)
    for samples in (*wrong, [(now_ms - 9 * DAY_MS, 1.0)], [(now_ms + DAY_MS, 1.0)]):
        problem(anna.post(path, body(samples)), 422, "invalid")
    for query in ({"from": 5, "to": 5}, {"from": 0}, {"from": "x"}, {"samples": 1001}, {"transport": "pigeon"}):
        problem(anna.get(path, params=query), 422, "invalid")
    assert latencies(anna, robot.device) == []


def test_repeating_an_interrupted_batch_completes_it(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ms = cloud.clock.now_ms()
    spread = body([(now_ms - hour * HOUR_MS, 10.0) for hour in range(100)])
    real = cloud.functions.tables.batch
    calls = 0

    async def fail_after_first(table: str, writes: Any) -> Any:
        nonlocal calls
        calls += table == records.LATENCY
        if table == records.LATENCY and calls > 1:
            raise RuntimeError("killed")
        return await real(table, writes)

    monkeypatch.setattr(cloud.functions.tables, "batch", fail_after_first)
    assert anna.post(f"/devices/{robot.device}/latency", spread).status_code == 500
    monkeypatch.undo()
    assert anna.post(f"/devices/{robot.device}/latency", spread).status_code == 204
    (series,) = latencies(anna, robot.device, **{"from": now_ms - 7 * DAY_MS})
    assert series["count"] == 100


def test_hours_are_deleted_after_their_retention_and_days_remain(cloud: Cloud, anna: Person, robot: Robot) -> None:
    now_ms = cloud.clock.now_ms()
    spread = body([(now_ms - hour * HOUR_MS, 10.0) for hour in range(30)])
    assert anna.post(f"/devices/{robot.device}/latency", spread).status_code == 204

    def kinds() -> set[str]:
        caller = Identity(anna.account, anna.name, anna.session)
        view = cloud.run(cloud.functions.devices.view(caller, robot.device))
        partition = f"{robot.device}/{view.device.pairing}"
        page = cloud.run(cloud.functions.tables.query(records.LATENCY, partition, limit=1000))
        return {row.key.partition(":")[0] for row in page.rows}

    assert kinds() == {"day", "hour", "once", "recent"}
    cloud.clock.advance(11 * 86_400)
    cloud.sweep()
    assert kinds() == {"day", "hour", "recent"}
    cloud.clock.advance((KEEP_HOURS_MS - 9 * DAY_MS) / 1000)
    cloud.sweep()
    assert kinds() == {"day", "recent"}


def test_the_latencies_of_an_ended_action_are_counted_once(cloud: Cloud, anna: Person, robot: Robot) -> None:
    clock = cloud.clock

    def late(_: object) -> list[Ack]:
        """Acks of an agent whose clock is ten years ahead, and which starts after 250 ms."""
        ahead_ms = 10 * 365 * DAY_MS
        now_ms = clock.now_ms() + ahead_ms
        times = ((AckStatus.RECEIVED, 0), (AckStatus.ACCEPTED, 100), (AckStatus.STARTED, 250))
        return [robot.ack(robot.commands[-1].id, status, at_ms=now_ms + ms) for status, ms in times]

    robot.reports = late
    for number in range(3):
        action = anna.start(robot.device, wait_ms=10_000).json()["id"]
        done = robot.report(action, AckStatus.DONE)
        assert len(_ms(anna, robot, "received-started")) == number + 1
        robot.publish(robot.topic(topics.ACK), done)
    cloud.run(ingest(cloud.functions, robot.topic(topics.ACK), codec.encode(done)))
    assert _ms(anna, robot, "received-started") == [250.0] * 3
    answered, started = (_ms(anna, robot, path) for path in ("command-answered", "command-started"))
    assert len(answered) == len(started) == 3
    for first, second in zip(answered, started, strict=True):
        assert 0 <= first <= second < 60_000, "measured by the cloud's clock, not the agent's"


def test_an_action_that_ends_before_its_request_returns_is_measured(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    follow = ActionAcks.follow

    async def follow_late(self: ActionAcks, stored: StoredAction, acks: Any, **options: Any) -> Action:
        for status in (AckStatus.RECEIVED, AckStatus.ACCEPTED, AckStatus.STARTED, AckStatus.DONE):
            ack = robot.ack(stored.action.id, status, at_ms=cloud.clock.now_ms())
            await ingest(cloud.functions, robot.topic(topics.ACK), codec.encode(ack))
        return await follow(self, stored, acks, **options)

    monkeypatch.setattr(ActionAcks, "follow", follow_late)
    robot.silent = True
    assert anna.start(robot.device, wait_ms=0).json()["status"] == "done"
    for path in ("command-answered", "command-started", "received-started"):
        assert len(_ms(anna, robot, path)) == 1, path


def _ms(person: Person, robot: Robot, path: str) -> list[float]:
    series = latencies(person, robot.device, path=path)
    return series[0]["ms"] if series else []
