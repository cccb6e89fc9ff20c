"""Stored bytes of accounts, devices and the disk are limited; control continues."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from function_app.adapters.local.blobs import FileBlobs
from function_app.domain.common.problems import Problem
from function_app.ports.blobs import TransferRefused
from function_app.ports.tables import Conflict, Row
from function_app.services.storage import records
from function_app.services.storage.quota import Usage, release
from function_app.services.telemetry.uploads import SHARDS, UNREGISTERED_MS
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import Cloud, Person, problem

KB = 1_000
CAPTURE = {"stream": "camera", "length": KB, "content_type": "image/png"}
MOVE = {"kind": "move_joints", "position_rad": {"shoulder_pan": 0.1}, "speed": 1.0}
SCRIPT = {"source": "print('here')"}


def limit(cloud: Cloud, **limits: int) -> None:
    cloud.functions.quota.limits = replace(cloud.functions.quota.limits, **limits)


def begin(anna: Person, robot: Robot, length: int = KB) -> httpx.Response:
    return anna.post(f"/devices/{robot.device}/uploads", {**CAPTURE, "length": length})


def storage(anna: Person) -> dict[str, Any]:
    shown: dict[str, Any] = anna.get("/accounts/me").json()["storage"]
    return shown


def used(cloud: Cloud, account: str) -> int:
    """Stored bytes, also after the end of the session."""
    return cloud.run(cloud.functions.quota.usage(account)).total_bytes


@pytest.mark.parametrize("kind", ["account_bytes", "device_bytes"])
def test_captures_beyond_the_limit_are_rejected_until_others_are_deleted(
    cloud: Cloud, anna: Person, robot: Robot, kind: str
) -> None:
    limit(cloud, **{kind: 2 * KB})
    started = begin(anna, robot).json()
    anna.cloud.request("PUT", started["url"], headers=started["headers"], content=bytes(KB))
    anna.post(f"/devices/{robot.device}/uploads/{started['id']}/complete")
    begin(anna, robot)
    rejected = begin(anna, robot, 1)
    problem(rejected, 413, "quota-exceeded")
    assert rejected.json()["used_bytes"] == 2 * KB
    assert storage(anna)["devices"] == {robot.device: 2 * KB}
    assert anna.delete(f"/devices/{robot.device}/uploads/{started['id']}").status_code == 204
    assert begin(anna, robot).status_code == 201


def test_unregistered_captures_are_counted_until_they_are_deleted(cloud: Cloud, anna: Person, robot: Robot) -> None:
    begin(anna, robot)
    assert storage(anna)["used_bytes"] == KB
    cloud.clock.advance(UNREGISTERED_MS // 1000 + 1)
    for _ in range(SHARDS):
        cloud.run(cloud.functions.uploads.delete_due())
    assert used(cloud, anna.account) == 0


def test_concurrent_reservations_never_exceed_the_limit(alone: Cloud) -> None:
    limit(alone, account_bytes=5 * KB)

    async def reserve_many() -> int:
        results = await asyncio.gather(
            *(alone.functions.quota.reserve("anna", f"blob-{number}", KB) for number in range(20)),
            return_exceptions=True,
        )
        assert all(result is None or isinstance(result, Problem) for result in results)
        return (await alone.functions.quota.usage("anna")).total_bytes

    assert alone.run(reserve_many()) == 5 * KB
    rows = alone.run(alone.functions.tables.query(records.USAGE, "anna")).rows
    assert sum(row.data.get("bytes", 0) for row in rows) == 5 * KB
    assert alone.run(alone.functions.quota.usage("other")).total_bytes == 0


def test_requests_of_one_process_do_not_conflict_in_a_store_with_latency(
    alone: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = alone.functions.tables
    get, batch, batches = tables.get, tables.batch, 0

    async def late_get(*place: str) -> Row | None:
        await asyncio.sleep(0)
        return await get(*place)

    async def counted_batch(table: str, writes: Any) -> Any:
        nonlocal batches
        batches += 1
        return await batch(table, writes)

    monkeypatch.setattr(tables, "get", late_get)
    monkeypatch.setattr(tables, "batch", counted_batch)

    async def reserve_many() -> None:
        await asyncio.gather(*(alone.functions.quota.reserve("anna", f"blob-{number}", KB) for number in range(20)))

    alone.run(reserve_many())
    assert (used(alone, "anna"), batches) == (20 * KB, 20)


def test_the_sums_of_a_former_version_are_counted_once(alone: Cloud) -> None:
    tables, quota = alone.functions.tables, alone.functions.quota
    limit(alone, account_bytes=4 * KB, device_bytes=3 * KB)
    for name, device in (("captures/a", "arm"), ("captures/b", "arm"), ("movements/c", "")):
        alone.run(tables.create(records.USAGE, Row("anna", name, {"bytes": KB, "device": device})))
    assert alone.run(quota.usage("anna")) == Usage(3 * KB, {"arm": 2 * KB})
    alone.run(quota.reserve("anna", "captures/d", KB, device="arm"))
    for device in ("arm", "base"):
        with pytest.raises(Problem) as refused:
            alone.run(quota.reserve("anna", "captures/e", KB, device=device))
        assert refused.value.code == "quota-exceeded"
    alone.run(release(tables, "anna", "captures/a"))
    assert alone.run(quota.usage("anna")) == Usage(3 * KB, {"arm": 2 * KB})


def test_a_repeated_reservation_and_release_count_once(alone: Cloud) -> None:
    tables, quota = alone.functions.tables, alone.functions.quota
    limit(alone, account_bytes=5 * KB)
    for size in (2 * KB, 2 * KB, 3 * KB):
        alone.run(quota.reserve("anna", "captures/a", size, device="arm"))
        assert alone.run(quota.usage("anna")) == Usage(size, {"arm": size})
    with pytest.raises(Problem):
        alone.run(quota.reserve_all("anna", {"captures/a": KB, "captures/b": 5 * KB}, device="arm"))
    assert alone.run(quota.usage("anna")) == Usage(3 * KB, {"arm": 3 * KB}), "rejected together"
    for _ in range(2):
        alone.run(release(tables, "anna", "captures/a"))
        assert alone.run(quota.usage("anna")) == Usage()


def test_a_reservation_reads_no_other_blobs(alone: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    tables, quota = alone.functions.tables, alone.functions.quota
    alone.run(quota.reserve("anna", "captures/a", KB))
    monkeypatch.setattr(tables, "query", None)
    alone.run(quota.reserve("anna", "captures/b", KB))
    assert alone.run(quota.usage("anna")).total_bytes == 2 * KB


def test_a_deletion_that_cannot_change_the_sums_is_repeated(
    cloud: Cloud, anna: Person, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = cloud.functions.tables
    batch = tables.batch

    async def conflict(table: str, writes: Any) -> Any:
        if table == records.USAGE:
            raise Conflict("changed")
        return await batch(table, writes)

    def delete_due() -> None:
        for _ in range(SHARDS):
            cloud.run(cloud.functions.uploads.delete_due())
        for _ in range(3):
            cloud.run(cloud.functions.retention.delete_due(cloud.clock.now_ms()))

    begin(anna, robot)
    anna.put("/robot-types/ur5/movements/mine", SCRIPT)
    anna.delete("/robot-types/ur5/movements/mine")
    counted = used(cloud, anna.account)
    cloud.clock.advance(4 * 86_400)
    with monkeypatch.context() as contended:
        contended.setattr(tables, "batch", conflict)
        delete_due()
        assert used(cloud, anna.account) == counted == KB + len(SCRIPT["source"])
    delete_due()
    assert used(cloud, anna.account) == 0


def test_scripts_count_until_their_blob_is_deleted(cloud: Cloud, anna: Person) -> None:
    assert anna.put("/robot-types/ur5/movements/mine", SCRIPT).status_code == 201
    assert storage(anna)["used_bytes"] == len(SCRIPT["source"])
    limit(cloud, account_bytes=storage(anna)["used_bytes"])
    problem(anna.put("/robot-types/ur5/movements/mine", {"source": "print('more')"}), 413, "quota-exceeded")
    anna.delete("/robot-types/ur5/movements/mine")
    assert storage(anna)["used_bytes"] > 0  # running actions may need it
    cloud.clock.advance(4 * 86_400)
    for _ in range(3):
        cloud.run(cloud.functions.retention.delete_due(cloud.clock.now_ms()))
    assert used(cloud, anna.account) == 0


def test_control_continues_on_a_full_disk_while_data_is_rejected(cloud: Cloud, anna: Person, robot: Robot) -> None:
    cloud.functions.quota.free_bytes = lambda: cloud.functions.quota.limits.min_free_bytes
    problem(begin(anna, robot), 507, "storage-full")
    problem(anna.put("/robot-types/ur5/movements/mine", SCRIPT), 507, "storage-full")
    assert cloud.functions.quota.refuse_measurement(robot.device, 100)
    lease = anna.post(f"/devices/{robot.device}/lease")
    assert lease.status_code in {200, 201}, lease.text
    action = anna.post(f"/devices/{robot.device}/actions", {"request": MOVE})
    assert action.status_code < 300, action.text


def test_measurements_of_a_device_are_limited_by_day(alone: Cloud) -> None:
    limit(alone, series_bytes=2 * KB)
    refuse = alone.functions.quota.refuse_measurement
    assert [bool(refuse("arm", KB)) for _ in range(3)] == [False, False, True]
    assert not refuse("other", KB)
    alone.clock.advance(86_400)
    assert not refuse("arm", KB)


def test_an_upload_ends_when_the_disk_is_full(tmp_path: Path) -> None:
    full = False
    blobs = FileBlobs(tmp_path, is_full=lambda: full)

    async def upload() -> None:
        nonlocal full
        request = await blobs.presign_upload("a", length=2 * KB, content_type="text/plain", lifetime_s=60)

        async def content() -> Any:
            nonlocal full
            yield bytes(KB)
            full = True
            yield bytes(KB)

        await blobs.receive(request.url.rpartition("/")[2], {"content-type": "text/plain"}, content())

    with pytest.raises(TransferRefused, match="disk is almost full") as refused:
        asyncio.run(upload())
    assert refused.value.status == 507
    assert list(tmp_path.iterdir()) == []
