"""The server reports damaged, replaced and full tables, and continues where it can."""

import sqlite3
from pathlib import Path

import pytest

from function_app.ports.tables import Row
from function_app.services.storage import records
from function_app.settings import StorageLimits
from tests.harness.cloud.cloud import API, Cloud, problem, settings
from tests.harness.network.brokers import wait_until


def test_damaged_rows_make_the_server_degraded_and_are_not_served(tmp_path: Path) -> None:
    with Cloud(settings(tmp_path)) as cloud:
        anna = cloud.sign_in("anna")
        bob = cloud.sign_in("bob")
        bob_id = bob.get("/accounts/me").json()["id"]
        assert bob.get("/health").json()["tables"] == "ok"
        with sqlite3.connect(tmp_path / "tables.sqlite") as database:
            damage = "UPDATE rows SET data = replace(data, ':', ': ') WHERE tab = 'Accounts' AND part <> ?"
            assert database.execute(damage, (bob_id,)).rowcount > 0
        problem(anna.get("/accounts/me"), 503, "store-unavailable")
        cloud.run(cloud.functions.tables.check(thorough=True))
        wait_until(lambda: bob.get("/health").json()["tables"] != "ok", "the next check")
        answer = bob.get("/health")
        assert (answer.status_code, answer.json()["status"]) == (200, "degraded")
        assert "'Accounts'" in answer.json()["tables"]
        assert "is damaged" in answer.json()["tables"]


@pytest.mark.parametrize("name", ["tables.sqlite", "tables.sqlite-wal"])
def test_replaced_tables_are_unhealthy_and_no_write_is_acknowledged(tmp_path: Path, name: str) -> None:
    with Cloud(settings(tmp_path)) as cloud:
        anna = cloud.sign_in("anna")
        (tmp_path / name).unlink()
        problem(anna.post("/api-keys", {"name": "k", "role": "viewer", "days": 1}), 503, "store-unavailable")
        problem(cloud.request("GET", f"{API}/health"), 503, "store-unavailable")
        assert "replaced or deleted" in cloud.run(cloud.functions.health.check()).text("tables")


def test_data_leave_space_for_control(tmp_path: Path) -> None:
    limits = StorageLimits(max_tables_mb=4, min_free_mb=2)
    with Cloud(settings(tmp_path, storage_limits=limits)) as cloud:
        anna = cloud.sign_in("anna")
        tables = cloud.functions.tables
        quota = cloud.functions.quota
        assert quota.refuse_measurement("device", 1_000) == ""

        async def fill(least: int) -> None:
            number = 0
            while (tables.left_bytes() or 0) > least:
                await tables.create(records.SERIES, Row("p", f"{least}-{number}", {"text": "x" * 100_000}))
                number += 1

        cloud.run(fill(1_900_000))
        assert "almost full" in quota.refuse_measurement("device", 1_000)
        answer = anna.put("/robot-types/ur5/movements/mine", {"source": "robot.home()"})
        problem(answer, 507, "storage-full")
        key = {"name": "k", "role": "viewer", "days": 1}
        assert anna.post("/api-keys", key).status_code == 201
        with pytest.raises(Exception, match="TELESCOPE_MAX_TABLES_MB"):
            cloud.run(fill(0))
        answers = (anna.post("/api-keys", key) for _ in range(200))
        problem(next(each for each in answers if each.status_code != 201), 507, "storage-full")
        assert (tmp_path / "tables.sqlite").stat().st_size <= 4_000_000
