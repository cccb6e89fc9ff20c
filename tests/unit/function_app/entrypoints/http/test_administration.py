"""The state of the installation is for administrators."""

import logging
from dataclasses import replace

import pytest

from device_agent.protocol.security import log_output
from function_app.ports.tables import Row
from function_app.services.maintenance.heartbeats import Heartbeat
from function_app.services.storage import records
from function_app.settings import Administration
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, problem


@pytest.fixture
def cloud(open_cloud: OpenCloud) -> Cloud:
    return open_cloud(administration=Administration(accounts=frozenset({"anna"})))


def test_an_administrator_reads_parts_workers_and_recent_errors(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    recent = log_output.RecentErrors()
    monkeypatch.setattr(log_output, "recent", recent)
    recent.handle(logging.LogRecord("x", logging.ERROR, "", 1, "of the server", (), None))
    now_ms = cloud.clock.now_ms()
    worker = Heartbeat(
        name="w-1", host="w", process=1, version="9", started_ms=0, seen_ms=now_ms, period_ms=1000, agents_online=2,
        errors=((now_ms + 60_000, "warning", "of the worker"),),
    )  # fmt: skip
    for beat in (worker, replace(worker, name="w-2", agents_online=1, errors=())):
        row = Row("workers", beat.name, records.to_data(beat))
        cloud.run(cloud.functions.tables.create(records.WORKERS, row))
    state = cloud.sign_in("Anna").get("/administration").json()
    assert (state["status"], state["agents_online"], state["tables_bytes"]) == ("failed", 2, None)
    assert [each["name"] for each in state["workers"]] == ["w-1", "w-2"]
    assert {part["name"]: part["status"] for part in state["parts"]}["workers"] == "ok"
    assert [(line["program"], line["message"]) for line in state["errors"]] == [
        ("w-1", "of the worker"), ("server", "of the server"),
    ]  # fmt: skip


def test_others_are_rejected(cloud: Cloud) -> None:
    problem(cloud.sign_in("bert").get("/administration"), 403, "forbidden")
    problem(cloud.request("GET", f"{API}/administration"), 401, "unauthorized")


def test_accounts_me_names_administrators(cloud: Cloud) -> None:
    assert [cloud.sign_in(name).get("/accounts/me").json()["administrator"] for name in ("anna", "bert")] == [
        True, False,
    ]  # fmt: skip
