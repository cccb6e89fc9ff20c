"""Rows and blobs are deleted when due, unless they were renewed."""

from typing import Any

from device_agent.protocol import AckStatus, Event, topics
from function_app.ports.tables import Row
from function_app.services.storage import records
from function_app.services.storage.retention import DAY_MS, NOTES, ROWS, SHARDS, Retention
from function_app.services.telemetry.event_log import KEEP_EVENTS_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person

Pair = tuple[Person, Robot]
NOW_MS = 1_800_000_000_000


def put(cloud: Cloud, *keys: str, **data: Any) -> None:
    for key in keys:
        cloud.run(cloud.functions.tables.create("Things", Row("p", key, data)))


def left(cloud: Cloud, table: str = "Things", partition: str = "p") -> list[str]:
    found: list[str] = []
    cursor: str | None = None
    while True:
        page = cloud.run(cloud.functions.tables.query(table, partition, limit=1000, cursor=cursor))
        found += [row.key for row in page.rows]
        cursor = page.cursor
        if cursor is None:
            return found


def notes(cloud: Cloud, table: str = "") -> list[str]:
    """Keys of scheduled deletions, optionally of one table only."""
    pages = [cloud.run(cloud.functions.tables.query(records.FORGET, str(shard), limit=1000)) for shard in range(SHARDS)]
    return [row.key for page in pages for row in page.rows if table in {"", row.data.get("table")}]


def run(cloud: Cloud, now_ms: int = NOW_MS) -> None:
    cloud.run(cloud.functions.retention.delete_due(now_ms))


def delete_later(cloud: Cloud, first: str = "", last: str | None = None, due_ms: int = NOW_MS) -> None:
    cloud.run(cloud.functions.retention.delete_rows_at("Things", "p", first=first, last=last, due_ms=due_ms))


def keys(cloud: Cloud, robot: Robot, kind: str) -> list[str]:
    return [key for key in left(cloud, records.CONTROL, robot.device) if key.startswith(f"{kind}:")]


class TestRows:
    def test_a_partition_is_deleted_with_rows_that_expire_later(self, alone: Cloud) -> None:
        put(alone, "a", expires_ms=NOW_MS + DAY_MS)
        put(alone, "b")
        delete_later(alone)
        run(alone)
        assert left(alone) == ["a"]
        alone.run(alone.functions.retention.delete_partition_at("Things", "p", due_ms=NOW_MS))
        run(alone)
        assert left(alone) == []

    def test_a_range_is_deleted_when_due(self, alone: Cloud) -> None:
        put(alone, "a", "b", "b1", "c", "x", "x1", "y", "zzz")
        delete_later(alone, "b", "c")
        for _ in range(2):
            alone.run(alone.functions.retention.delete_row_at("Things", "p", "x", due_ms=NOW_MS))
        delete_later(alone, "y")
        assert len(notes(alone)) == 3, "scheduling is idempotent"
        run(alone, NOW_MS - 1)
        assert left(alone) == ["a", "b", "b1", "c", "x", "x1", "y", "zzz"]
        run(alone)
        assert left(alone) == ["a", "c", "x1"]
        assert notes(alone) == []

    def test_a_renewed_row_remains_until_its_later_expiry(self, alone: Cloud) -> None:
        put(alone, "old", expires_ms=NOW_MS)
        put(alone, "renewed", expires_ms=NOW_MS + 1)
        delete_later(alone)
        run(alone)
        assert left(alone) == ["renewed"]
        delete_later(alone, due_ms=NOW_MS + 1)
        run(alone, NOW_MS + 1)
        assert left(alone) == []

    def test_many_rows_are_deleted_in_several_rounds(self, alone: Cloud) -> None:
        put(alone, *(f"a{number:04d}" for number in range(ROWS)), expires_ms=NOW_MS + 1)
        put(alone, *(f"b{number:04d}" for number in range(ROWS + 1)))
        delete_later(alone)
        for processed in (0, ROWS, 2 * ROWS):
            assert len(left(alone)) == 2 * ROWS + 1 - max(0, processed - ROWS)
            assert len(notes(alone)) == 1
            run(alone)
        assert len(left(alone)) == ROWS
        assert notes(alone) == []

    def test_many_scheduled_deletions_take_several_rounds(self, alone: Cloud) -> None:
        for number in range(2 * SHARDS * NOTES):
            alone.run(alone.functions.retention.delete_row_at("Things", "p", str(number), due_ms=NOW_MS))
        run(alone)
        assert 0 < len(notes(alone)) < 2 * SHARDS * NOTES
        for _ in range(4):
            run(alone)
        assert notes(alone) == []

    def test_large_rows_are_deleted(self, alone: Cloud) -> None:
        put(alone, *(f"{number:02d}" for number in range(20)), text="x" * 200_000)
        delete_later(alone)
        run(alone)
        assert left(alone) == []

    def test_a_concurrently_changed_row_is_read_again(self, alone: Cloud) -> None:
        put(alone, "a", "b")
        tables, inner = alone.functions.tables, alone.functions.tables.batch

        class Changing:
            """Tables that renew a row between reading and deleting it."""

            def __getattr__(self, name: str) -> Any:
                return getattr(tables, name)

            async def batch(self, *arguments: Any) -> Any:
                row = await tables.get("Things", "p", "a")
                assert row is not None
                await tables.replace("Things", Row("p", "a", {"expires_ms": NOW_MS + 1}, row.etag))
                return await inner(*arguments)

        delete_later(alone)
        alone.run(Retention(tables=Changing(), blobs=alone.functions.blobs).delete_due(NOW_MS))
        assert left(alone) == ["a", "b"]
        assert len(notes(alone)) == 1
        run(alone)
        assert left(alone) == ["a"]
        assert notes(alone) == []


def test_a_blob_is_deleted_when_due_and_a_missing_blob_is_ignored(alone: Cloud) -> None:
    blobs = alone.functions.blobs
    alone.run(blobs.put("a/b", b"content"))
    alone.run(alone.functions.retention.delete_blob_at("a/b", due_ms=NOW_MS))
    alone.run(alone.functions.retention.delete_blob_at("missing/blob", due_ms=NOW_MS))
    run(alone, NOW_MS - 1)
    assert alone.run(blobs.get("a/b")) == b"content"
    run(alone)
    assert alone.run(blobs.get("a/b")) is None
    assert notes(alone) == []


def test_an_action_is_kept_for_30_days_after_its_end_and_its_key_for_one_day(
    cloud: Cloud, anna: Person, robot: Robot
) -> None:
    action = anna.start(robot.device, idempotency_key="k", wait_ms=10_000).json()["id"]
    robot.report(action, AckStatus.DONE)
    assert anna.action(action, wait_ms=10_000)["status"] == "done"
    cloud.clock.advance(2)
    cloud.sweep()
    cloud.clock.advance(24 * 3600)
    cloud.sweep()
    anna = cloud.sign_in("anna")
    assert [item["id"] for item in anna.get(f"/devices/{robot.device}/actions").json()["items"]] == [action]
    assert keys(cloud, robot, "once") == []
    cloud.clock.advance(29 * 24 * 3600)
    cloud.sweep()
    assert keys(cloud, robot, "action") == []
    assert keys(cloud, robot, "now") != []
    assert notes(cloud, records.CONTROL) == []


def test_retention_does_not_depend_on_the_agents_clock(cloud: Cloud, anna: Person, robot: Robot) -> None:
    robot.reports = lambda command: (robot.ack(command.id, AckStatus.DONE, at_ms=8_000_000_000_000),)
    anna.start(robot.device, wait_ms=10_000, wait_for="done")
    cloud.clock.advance(2)
    cloud.sweep()
    cloud.clock.advance(30 * 24 * 3600 + 300)
    cloud.sweep()
    assert keys(cloud, robot, "action") == []


def test_events_are_kept_for_90_days_with_one_deletion_per_day(cloud: Cloud, anna: Person, robot: Robot) -> None:

    def events() -> int:
        return len(anna.get(f"/devices/{robot.device}/events").json()["items"])

    now_ms = cloud.clock.now_ms()
    before = len(notes(cloud))
    for number in range(5):
        event = Event(id=f"e{number}", device="arm", kind="door", severity="info", at_ms=now_ms, message="open")
        robot.publish(robot.topic(topics.EVENT), event)
    assert events() == 5
    assert len(notes(cloud)) - before <= 2, "two around midnight"
    run(cloud, now_ms + KEEP_EVENTS_MS - DAY_MS)
    assert events() == 5
    run(cloud, now_ms + KEEP_EVENTS_MS + 2 * DAY_MS)
    assert events() == 0
    assert notes(cloud) == []


def test_a_sign_out_is_stored_until_its_tokens_expire(alone: Cloud) -> None:
    anna = alone.sign_in("anna")
    assert anna.post("/auth/sign-out").status_code == 204
    alone.clock.advance(12 * 3600 - 5)
    alone.sweep()
    assert any(key.startswith("signed-out:") for key in left(alone, records.ACCOUNTS, anna.account))
    alone.clock.advance(10)
    alone.sweep()
    assert not any(key.startswith("signed-out:") for key in left(alone, records.ACCOUNTS, anna.account))


def test_failed_attempts_are_deleted_after_their_window(alone: Cloud) -> None:
    anna = alone.sign_in("anna")
    for _ in range(3):
        anna.post("/agents/claim", {"code": "BCDF-GHJK"})
    assert len(left(alone, records.ATTEMPTS, anna.account)) == 1
    alone.clock.advance(601)
    alone.sweep()
    assert left(alone, records.ATTEMPTS, anna.account) == []
    assert notes(alone, records.ATTEMPTS) == []


def test_only_an_unclaimed_agent_is_deleted_after_a_week(cloud: Cloud) -> None:
    lost, waiting, claimed, given_back = (cloud.robot() for _ in range(4))
    anna = cloud.sign_in("anna")
    claimed.pair(anna)
    given_back.pair(anna)
    assert anna.delete(f"/agents/{given_back.id}").status_code == 204
    for robot in (lost, waiting, given_back):
        robot.enroll()
    for _ in range(9):
        cloud.clock.advance(24 * 3600)
        assert waiting.enroll().status_code == 201
        cloud.sweep()
    for _ in range(3):
        cloud.sweep()
    found = [len(left(cloud, records.AGENTS, robot.id)) for robot in (lost, waiting, claimed, given_back)]
    assert found == [0, 1, 1, 0]
    cloud.clock.advance(100 * 24 * 3600)
    for _ in range(5):
        cloud.sweep()
    anna = cloud.sign_in("anna")
    assert [item["id"] for item in anna.get("/agents").json()["items"]] == [claimed.id]
    assert left(cloud, records.AGENTS, waiting.id) == []
    given_back.pair(anna)
    assert len(anna.get("/agents").json()["items"]) == 2


def test_an_agent_claimed_shortly_before_its_deletion_remains(alone: Cloud) -> None:
    robot, anna = alone.robot(), alone.sign_in("anna")
    robot.enroll()
    alone.clock.advance(9 * 24 * 3600)
    anna = alone.sign_in("anna")
    robot.pair(anna)
    for _ in range(3):
        alone.sweep()
    assert [item["id"] for item in anna.get("/agents").json()["items"]] == [robot.id]
