"""Contents and readers of the audit log."""

import asyncio
from typing import Any

import pytest

from device_agent.protocol import Event, StopDevice, topics
from function_app.domain.audit.hash_chain import CLOUD, Head, entry
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Conflict
from function_app.services.audit.audit_log import ANCHOR_MS, anchors
from function_app.services.storage import records as store
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, Cloud, Person, problem

OWNER = "owner"
CALLER = Identity(OWNER, "anna", "s")


def kinds(person: Person, **query: Any) -> list[str]:
    return [record["event"] for record in person.pages("/accounts/me/audit", **query)]


def verdict(cloud: Cloud, chain: str, *expected: Head) -> str:
    return cloud.run(cloud.functions.audit_reader.verify(chain, expected=expected)).broken


class TestWhatIsRecorded:
    def test_operations_are_recorded_with_their_session(self, cloud: Cloud) -> None:
        anna, again = cloud.sign_in("anna"), cloud.sign_in("anna")
        with cloud.robot() as robot:
            device = robot.pair(anna)
            robot.connect()
            epoch = anna.take_lease(device).json()["epoch"]
            problem(again.take_lease(device), 409, "lease-held")
            anna.post(f"/devices/{device}/stop", {"reason": "look out"})
            anna.post(f"/devices/{device}/stop/reset")
            assert epoch == 1
            problem(anna.post("/agents/claim", {"code": "BCDF-GHJK"}), 404, "claim-code-unknown")
            assert anna.delete(f"/agents/{robot.id}").status_code == 204
        items = anna.get("/accounts/me/audit").json()["items"]
        rows = [(item["event"], item["outcome"], item["session"], item["target"]) for item in reversed(items)]
        assert [row for row in rows if "sign" not in row[0]] == [
            ("agent-claimed", "done", anna.session, robot.id),
            ("control-taken", "done", anna.session, device),
            ("command-rejected", "rejected", again.session, device),
            ("stop-ordered", "done", anna.session, device),
            ("stop-reset-ordered", "done", anna.session, device),
            ("claim-rejected", "rejected", anna.session, ""),
            ("agent-unpaired", "done", anna.session, robot.id),
        ]
        stop = next(item for item in items if item["event"] == "stop-ordered")
        assert (stop["actor"], stop["account"], stop["data"]["reason"]) == ("anna", anna.account, "look out")
        assert verdict(cloud, anna.account) == ""

    def test_a_stop_that_the_device_reports_is_recorded_once_with_its_unverified_author(
        self, cloud: Cloud, anna: Person, robot: Robot
    ) -> None:
        data = {"caller": "eve\n\u202eforged", "reason": "smoke", "verified": True}
        event = Event(
            id="e1", device="arm", at_ms=5, kind="stop-latched", severity="warning", message="stopped by eve", data=data
        )
        for _ in range(2):
            robot.publish(robot.topic(topics.EVENT), event)
        items = anna.get("/accounts/me/audit").json()["items"]
        (stop,) = [item for item in items if item["event"] == "stop-latched"]
        assert (stop["actor"], stop["account"]) == ("eve\ufffd\ufffdforged (unverified)", "")
        expected = {"message": "stopped by eve", "caller": stop["actor"], "reason": "smoke", "verified": False}
        assert (stop["target"], stop["data"]) == (robot.device, expected)
        assert verdict(cloud, anna.account) == ""

    @pytest.mark.parametrize(("delay_s", "other_id", "records"), [(5, "", 1), (3600, "", 2), (5, "s1", 2)])
    def test_a_stop_over_http_is_recorded_once_and_a_replay_of_its_id_again(  # noqa: PLR0917 (fixtures and parameters)
        self, cloud: Cloud, anna: Person, robot: Robot, delay_s: float, other_id: str, records: int
    ) -> None:
        anna.post(f"/devices/{robot.device}/stop", {"reason": "smoke"})
        (stop,) = {stop.id for stop in robot.stops}
        assert {command.id for command in robot.received(StopDevice)} == {stop}
        cloud.clock.advance(delay_s)
        data = {"stop": other_id or stop, "caller": "anna (unverified)", "reason": "smoke", "verified": False}
        robot.publish(
            robot.topic(topics.EVENT),
            Event(id="e1", device="arm", at_ms=5, kind="stop-latched", severity="warning", message="m", data=data),
        )
        assert len(anna.get(f"/devices/{robot.device}/events").json()["items"]) == 2
        assert [kind for kind in kinds(anna) if kind.startswith("stop")] == ["stop-latched", "stop-ordered"][-records:]

    def test_sign_ins_are_recorded_without_secrets(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        assert anna.put("/accounts/me/password", {"password": "correct horse battery"}).status_code == 204
        wrong = {"name": "anna", "password": "wrong wrong wrong"}
        before = cloud.run(cloud.functions.audit_reader.head(CLOUD)) or Head(0, "")
        for name in ("anna", "unknown", "anna"):
            answer = cloud.request("POST", f"{API}/auth/password", json={**wrong, "name": name})
            assert answer.status_code == 401, answer.text
        assert cloud.request("POST", f"{API}/auth/sign-in", json={"link": "x" * 43}).status_code == 401
        again = cloud.sign_in("anna")
        again.post("/auth/sign-out")
        assert kinds(anna) == ["signed-out", "signed-in", *["sign-in-rejected"] * 2, "password-set", "signed-in"]
        after = cloud.run(cloud.functions.audit_reader.head(CLOUD))
        assert after is not None
        assert after.seq == before.seq + 2, "a record for the unknown name and one for the link"
        text = anna.get("/accounts/me/audit").text
        assert not [secret for secret in ("horse", "wrong wrong", anna.token) if secret in text]

    def test_operations_on_shared_devices_are_in_the_owners_log(self, cloud: Cloud) -> None:
        anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        robot = cloud.robot()
        device = robot.pair(anna)
        anna.post(f"/devices/{device}/shares", {"account": "bert", "role": "operator"})
        bert.take_lease(device)
        anna.delete(f"/devices/{device}/shares/{bert.account}")
        secret = anna.post(f"/devices/{device}/invitations", {"role": "viewer"}).json()["secret"]
        assert bert.post("/invitations/redeem", {"secret": secret}).status_code == 200
        problem(bert.take_lease(device), 403, "forbidden")
        items = [item for item in reversed(anna.get("/accounts/me/audit").json()["items"]) if device in item["target"]]
        assert [(item["event"], item["actor"]) for item in items] == [
            ("shared", "anna"),
            ("control-taken", "bert"),
            ("unshared", "anna"),
            ("invited", "anna"),
            ("invitation-redeemed", "bert"),
            ("shared", "anna"),
            ("command-rejected", "bert"),
        ]
        assert not [kind for kind in kinds(bert) if "sign" not in kind]
        assert verdict(cloud, anna.account) == ""

    def test_changes_of_movements_are_recorded(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        anna.put("/robot-types/ur5/movements/mine", {"source": "1"})
        anna.put("/robot-types/ur5/movements/mine", {"source": "2"})
        problem(anna.put("/robot-types/ur5/movements/mine", {"source": "("}), 422, "movement-invalid")
        anna.delete("/robot-types/ur5/movements/mine")
        problem(anna.delete("/robot-types/ur5/movements/mine"), 404, "movement-unknown")
        items = anna.get("/accounts/me/audit", params={"target": "ur5/mine"}).json()["items"]
        assert [item["event"] for item in items] == ["movement-deleted", "movement-saved", "movement-saved"]
        assert [item["data"]["version"] for item in items[1:]] == [2, 1]

    def test_an_account_reads_only_its_own_records_newest_first(self, cloud: Cloud) -> None:
        anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        chain = cloud.functions.audit_log
        for number in range(25):
            cloud.run(chain.record(anna.account, "even" if number % 2 == 0 else "odd", CALLER, on=f"d{number % 5}"))
        sequences = [item["seq"] for item in anna.pages("/accounts/me/audit", limit=4, event="even")]
        assert len(sequences) == 13
        assert sequences == sorted(sequences, reverse=True)
        assert kinds(anna, target="d3", event="odd") == ["odd", "odd", "odd"]
        assert kinds(anna, to=1) == []
        assert not {"even", "odd"} & set(kinds(bert))
        for cursor in ("x", "-1", "9" * 13, "\u0661"):
            problem(anna.get("/accounts/me/audit", params={"cursor": cursor}), 422, "cursor-invalid")

    def test_a_repeated_refusal_is_recorded_every_ten_seconds(self, cloud: Cloud) -> None:
        for pause_s in (0, 0, 0, 0, 11):
            cloud.clock.advance(pause_s)
            cloud.run(cloud.functions.audit_log.record_rejection(OWNER, "sign-in-rejected", None, address="192.0.2.1"))
        head = cloud.run(cloud.functions.audit_reader.head(OWNER))
        assert head is not None
        assert head.seq == 2


def test_a_repeated_write_is_recorded_once(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    """Client libraries of stores retry requests, and not every store detects the duplicate."""
    functions = cloud.functions
    batch = functions.tables.batch
    lost: list[str] = []

    async def losing(table: str, writes: Any) -> Any:
        done = await batch(table, writes)
        if table == store.AUDIT:
            lost.append(table)
            if len(lost) % 2:
                raise Conflict("the batch was already written")
        return done

    monkeypatch.setattr(functions.tables, "batch", losing)

    async def work() -> list[str]:
        async with functions.audit_log.change(OWNER, "changed", CALLER) as change:
            await change.store_pending()
        await asyncio.gather(*(functions.audit_log.record(OWNER, f"did {number}", CALLER) for number in range(3)))
        repeated = entry("repeated", CALLER, entry_id="repeated", at_ms=functions.clock.now_ms())
        for _ in range(2):
            await functions.audit_log.append_all(OWNER, [repeated])
        page = await functions.tables.query(store.AUDIT, OWNER, first="record:", last="record;", limit=1000)
        return [str(row.data["event"]) for row in page.rows]

    assert sorted(cloud.run(work())) == ["changed", "did 0", "did 1", "did 2", "repeated"]
    assert len(lost) > 2
    assert verdict(cloud, OWNER) == ""


def test_the_timer_anchors_each_hour_with_new_records(cloud: Cloud) -> None:
    clock = cloud.clock
    chain, blobs = cloud.functions.audit_log, cloud.functions.blobs

    for new_records, expected in ((2, 1), (2, 2), (0, 2)):
        for _ in range(new_records):
            cloud.run(chain.record(OWNER, "did", CALLER))
        clock.advance(ANCHOR_MS / 1000)
        cloud.sweep()
        assert (cloud.run(blobs.get(anchors(OWNER))) or b"").count(b"\n") == expected
    assert cloud.run(cloud.functions.audit_reader.verify(OWNER)).anchors == 2
