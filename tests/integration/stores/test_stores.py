"""Two instances of the functions over each store: each reads what the other writes."""

import asyncio
import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import AckStatus, Fault, Measurements, Mode, RunMovement, State, codec, topics
from function_app.adapters import factory
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from function_app.services.robot_types.delete import AFTER_MS
from function_app.services.storage.records import CONTROL
from function_app.settings import AwsStore, AzureStore, read
from tests.conftest import Emulators
from tests.harness.cloud.cloud import MOVE, Cloud, Person, paired, problem, settings
from tests.harness.network.brokers import RunningBroker
from tests.harness.paths import UR5
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import STORES, StoreKind, empty_store

MINE = "/robot-types/ur5/movements/mine"
SOURCE = '"""Wave."""\nrobot.home()\n'


@pytest.fixture(params=STORES)
def store(
    request: pytest.FixtureRequest, emulators: Emulators, monkeypatch: pytest.MonkeyPatch
) -> AzureStore | AwsStore | None:
    """An empty store."""
    kind: StoreKind = request.param
    if kind == "aws":
        use_credentials(monkeypatch)
    return read(empty_store(kind, emulators(kind))).store


@pytest.fixture
def clouds(home: Path, broker: RunningBroker, store: AzureStore | AwsStore | None) -> Iterator[tuple[Cloud, Cloud]]:
    """Two instances; the ingest runs in the second."""
    chosen = replace(settings(home, broker), store=store)
    asyncio.run(factory.prepare(chosen))
    with contextlib.ExitStack() as stack:
        one, other = (stack.enter_context(Cloud(chosen)) for _ in range(2))
        other.start_ingest()
        yield one, other


def test_a_robot_is_paired_leased_and_runs_a_movement(clouds: tuple[Cloud, Cloud]) -> None:
    one, other = clouds
    with paired(one) as (anna, robot):
        again = other.sign_in("anna")
        assert [device["id"] for device in again.get("/devices").json()["items"]] == [robot.device]

        assert anna.put(MINE, {"source": SOURCE}).status_code == 201
        assert again.put(MINE, {"source": SOURCE + "#"}).json()["version"] == 2
        assert anna.get(MINE).json()["source"] == SOURCE + "#"

        epoch = anna.take_lease(robot.device).json()["epoch"]
        problem(again.take_lease(robot.device), 409, "lease-held")
        assert again.get(f"/devices/{robot.device}/lease").json()["lease"]["epoch"] == epoch

        request = {"kind": "run_movement", "name": "mine", "parameters": {"note": "grüß 🤖"}}
        options: dict[str, Any] = {"request": request, "epoch": epoch, "wait_ms": 10_000, "idempotency_key": "a/b#c?"}
        action = anna.start(robot.device, **options).json()
        assert action["status"] == "started"
        assert anna.start(robot.device, **options).json()["id"] == action["id"]
        problem(anna.start(robot.device, epoch=epoch), 409, "device-busy")
        (command,) = robot.received(RunMovement)
        assert isinstance(command.request, RunMovement)
        assert command.request.source == SOURCE + "#"

        robot.report(action["id"], AckStatus.DONE, result={"reached": True})
        final = again.action(action["id"], wait_ms=10_000, wait_for="done")
        assert (final["status"], final["result"]) == ("done", {"reached": True})
        for cloud in clouds:
            cloud.sweep()

        bert = other.sign_in("bert")
        problem(bert.get(f"/actions/{action['id']}"), 404, "action-unknown")
        problem(bert.get(f"/devices/{robot.device}"), 404, "device-unknown")
        problem(bert.get(MINE), 404, "movement-unknown")


def test_a_robot_type_is_uploaded_checked_by_the_other_instance_and_deleted(clouds: tuple[Cloud, Cloud]) -> None:
    one, other = clouds
    anna, again = one.sign_in("anna"), other.sign_in("anna")
    text = (UR5 / "robot.toml").read_text().replace('type = "ur5"', 'type = "mine"')
    files = {path.name: path.read_text() for path in UR5.glob("*.xml")}
    assert anna.post("/robot-types", {"manifest": text, "files": files, "wait_ms": 0}).status_code == 202
    assert other.run(other.functions.model_checks.run())
    assert not one.run(one.functions.model_checks.run())
    assert anna.get("/robot-types/mine").json()["state"] == "ready"
    assert {"mine", "ur5"} <= {item["type"] for item in again.get("/robot-types").json()["items"]}
    assert again.get("/robot-types/mine/files/ur5.xml").text == files["ur5.xml"]
    up = "/robot-types/mine/movements/up"
    for number in range(3):
        assert anna.put(up, {"source": f"# {number}"}).json()["version"] == number + 1
    assert [item["version"] for item in again.get(f"{up}/versions").json()["items"]] == [3, 2, 1]
    assert again.get(up, params={"version": 2}).json()["source"] == "# 1"
    problem(anna.delete("/robot-types/mine"), 409, "robot-type-in-use")
    assert again.delete(up).status_code == 204
    assert anna.delete("/robot-types/mine").status_code == 204
    problem(again.get("/robot-types/mine"), 404, "robot-type-unknown")
    other.clock.advance(AFTER_MS / 1000)
    other.sweep()
    assert one.run(one.functions.blobs.list("robot-types/")) == ()


def at(cloud: Cloud, person: Person) -> Person:
    """The same session at another instance."""
    account = {"id": person.account, "name": person.name}
    return Person(cloud, {"access_token": person.token, "session": person.session, "account": account})


def test_a_queue_is_shared_and_ends_with_the_pairing(clouds: tuple[Cloud, Cloud]) -> None:
    one, other = clouds
    with paired(one) as (anna, robot):
        there = at(other, anna)
        running = anna.start(robot.device, wait_ms=10_000).json()["id"]
        calls = [
            person.begin("POST", f"/devices/{robot.device}/actions", json={"request": MOVE, "policy": "queue"})
            for person in (anna, there) * 2
        ]
        queued = {call().json()["id"] for call in calls}
        places = {anna.action(action)["queue_position"]: action for action in queued}
        assert sorted(places) == [1, 2, 3, 4]
        assert there.post(f"/actions/{places[3]}/cancel").json()["status"] == "cancelled"
        for before, action in ((running, places[1]), (places[1], places[2])):
            robot.report(before, AckStatus.DONE)
            assert there.action(action, wait_ms=20_000, wait_for="started")["status"] == "started"
        for cloud in clouds:
            cloud.sweep()
        assert there.delete(f"/agents/{robot.id}").status_code == 204
        problem(anna.get(f"/actions/{places[2]}"), 404, "action-unknown")
        rows = one.run(one.functions.tables.query(CONTROL, robot.device, first="action:", last="action;")).rows
        ends = {row.data["id"]: (row.data["status"], (row.data["reason"] or {}).get("code")) for row in rows}
        assert ends == {
            running: ("done", None),
            places[1]: ("done", None),
            places[2]: ("failed", "unpaired"),
            places[3]: ("cancelled", "cancelled"),
            places[4]: ("failed", "unpaired"),
        }
        for row in rows:
            one.run(one.functions.retention.delete_row_at(CONTROL, robot.device, row.key, due_ms=1))
        other.sweep()
        left = one.run(one.functions.tables.query(CONTROL, robot.device, first="action:", last="action;"))
        assert left.rows == ()


def test_faults_and_latencies_are_shared(clouds: tuple[Cloud, Cloud]) -> None:
    one, other = clouds
    with paired(one) as (anna, robot):
        there = at(other, anna)
        now_ms = one.clock.now_ms()

        def ingest_state(cloud: Cloud, *codes: str, at_ms: int) -> None:
            faults = tuple(Fault(code=code, message="Look.", since_ms=1) for code in codes)
            state = State(device="arm", at_ms=at_ms, tick_ms=at_ms, mode=Mode.IDLE, epoch=0, faults=faults)
            cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state)))

        ingest_state(one, "a/b#c?", at_ms=now_ms)
        ingest_state(other, "a/b#c?", at_ms=now_ms)
        measured = [
            Measurements(
                tick_ms=1, at_ms=now_ms - 60_000 + 10_000 * number, sequence=1, values={"temperature_c.x": 90.0}
            )
            for number in range(5)
        ]
        topic = topics.device(robot.space, robot.id, "arm", topics.TELE, "health")
        for cloud in clouds:
            cloud.run(ingest_telemetry(cloud.functions, [(topic, codec.encode(message)) for message in measured]))
        faults = f"/devices/{robot.device}/faults"
        opened = there.get(faults).json()["items"]
        assert sorted(fault["code"] for fault in opened) == ["a/b#c?", "health.temperature_c.x"]
        for fault in opened:
            assert there.post(f"{faults}/{fault['id']}/acknowledge").status_code == 200
        assert [fault["state"] for fault in anna.get(faults).json()["items"]] == ["acknowledged"] * 2
        assert anna.get("/diagnostics").json() == there.get("/diagnostics").json()
        ingest_state(other, at_ms=now_ms + 1)
        assert [fault["state"] for fault in anna.get(faults).json()["items"]] == ["acknowledged", "cleared"]

        samples = [{"at_ms": now_ms - number, "ms": 1.5 * number} for number in range(300)]
        latency = {"transport": "mqtt", "path": "operator-device", "samples": samples}
        for person in (anna, there):
            assert person.post(f"/devices/{robot.device}/latency", latency).status_code == 204
        (stored,) = there.get(f"/devices/{robot.device}/latency").json()["items"]
        assert (stored["count"], stored["max_ms"], len(stored["ms"])) == (300, 448.5, 300)
        for cloud in clouds:
            cloud.sweep()
