"""The audit log: what is recorded, and who may read it."""

import asyncio
import json
from typing import Any

import pytest

from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, Head, entry
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Conflict
from function_app.services.audit.audit_log import ANCHOR_MS, anchors
from function_app.services.storage import records as store
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, Person, problem

OWNER = "owner"
WHO = Identity(OWNER, "anna", "s")


def kinds(person: Person, **query: Any) -> list[str]:
    answer = person.get("/accounts/me/audit", params=query)
    assert answer.status_code == 200, answer.text
    return [record["event"] for record in answer.json()["items"]]


async def everything(functions: Functions, chain: str = OWNER) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    cursor = None
    while True:
        page = await functions.tables.query(
            store.AUDIT, chain, first="record:", last="record;", limit=1000, cursor=cursor
        )
        found += [dict(row.data) for row in page.rows]
        cursor = page.cursor
        if cursor is None:
            return found


def verdict(cloud: Cloud, chain: str, *expected: Head) -> str:
    return cloud.run(cloud.functions.audit_reader.verify(chain, expected=expected)).broken


class TestWhatIsRecorded:
    def test_claim_control_stop_refusal_and_un_pairing_are_told_with_who_it_was(self, cloud: Cloud) -> None:
        anna, again = cloud.sign_in("anna"), cloud.sign_in("anna")
        with cloud.robot() as robot:
            device = robot.pair(anna)
            robot.connect()
            epoch = anna.take(device).json()["epoch"]
            problem(again.take(device), 409, "lease-held")
            anna.post(f"/devices/{device}/stop", {"reason": "look out"})
            anna.post(f"/devices/{device}/stop/reset")
            assert epoch == 1
            problem(anna.post("/agents/claim", {"code": "BCDF-GHJK"}), 404, "claim-code-unknown")
            assert anna.delete(f"/agents/{robot.id}").status_code == 204
        items = anna.get("/accounts/me/audit").json()["items"]
        found = [(item["event"], item["outcome"], item["session"], item["target"]) for item in reversed(items)]
        assert [each for each in found if "sign" not in each[0]] == [
            ("agent-claimed", "done", anna.session, robot.id),
            ("control-taken", "done", anna.session, device),
            ("order-refused", "rejected", again.session, device),
            ("stop-ordered", "done", anna.session, device),
            ("stop-reset-ordered", "done", anna.session, device),
            ("claim-refused", "rejected", anna.session, ""),
            ("agent-unpaired", "done", anna.session, robot.id),
        ]
        stop = next(item for item in items if item["event"] == "stop-ordered")
        assert (stop["actor"], stop["account"], stop["data"]["reason"]) == ("anna", anna.account, "look out")
        assert verdict(cloud, anna.account) == ""

    def test_who_signs_in_and_out_and_who_tries_in_vain_is_recorded_without_any_secret(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        assert anna.put("/accounts/me/password", {"password": "correct horse battery"}).status_code == 204
        wrong = {"name": "anna", "password": "wrong wrong wrong"}
        before = cloud.run(cloud.functions.audit_reader.head(CLOUD)) or Head(0, "")
        for name in ("anna", "unknown", "anna"):
            answer = cloud.ask("POST", f"{API}/auth/password", json={**wrong, "name": name})
            assert answer.status_code == 401, answer.text
        assert cloud.ask("POST", f"{API}/auth/sign-in", json={"link": "x" * 43}).status_code == 401
        again = cloud.sign_in("anna")
        again.post("/auth/sign-out")
        assert list(reversed(kinds(anna))) == [
            "signed-in",
            "password-set",
            "sign-in-refused",
            "sign-in-refused",
            "signed-in",
            "signed-out",
        ]
        after = cloud.run(cloud.functions.audit_reader.head(CLOUD))
        assert after is not None
        assert after.seq == before.seq + 2, "one for the unknown name, one for the link"
        told = json.dumps(anna.get("/accounts/me/audit").json())
        assert not [secret for secret in ("horse", "wrong wrong", anna.token) if secret in told]

    def test_what_others_do_on_what_is_shared_stands_in_its_owners_chain(self, cloud: Cloud) -> None:
        anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        robot = cloud.robot()
        device = robot.pair(anna)
        anna.post(f"/devices/{device}/shares", {"account": "bert", "role": "operator"})
        bert.take(device)
        anna.delete(f"/devices/{device}/shares/{bert.account}")
        secret = anna.post(f"/devices/{device}/invitations", {"role": "viewer"}).json()["secret"]
        assert bert.post("/invitations/redeem", {"secret": secret}).status_code == 200
        problem(bert.take(device), 403, "forbidden")
        items = [item for item in reversed(anna.get("/accounts/me/audit").json()["items"]) if device in item["target"]]
        assert [(item["event"], item["actor"]) for item in items] == [
            ("shared", "anna"),
            ("control-taken", "bert"),
            ("unshared", "anna"),
            ("invited", "anna"),
            ("invitation-redeemed", "bert"),
            ("shared", "anna"),
            ("order-refused", "bert"),
        ]
        assert not [kind for kind in kinds(bert) if "sign" not in kind]
        assert verdict(cloud, anna.account) == ""

    def test_movements_are_told_and_what_was_refused_before_anything_changed_is_not(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        anna.put("/robot-types/ur5/movements/mine", {"source": "1"})
        anna.put("/robot-types/ur5/movements/mine", {"source": "2"})
        problem(anna.put("/robot-types/ur5/movements/mine", {"source": "("}), 422, "movement-invalid")
        anna.delete("/robot-types/ur5/movements/mine")
        problem(anna.delete("/robot-types/ur5/movements/mine"), 404, "movement-unknown")
        items = anna.get("/accounts/me/audit", params={"target": "ur5/mine"}).json()["items"]
        assert [item["event"] for item in items] == ["movement-deleted", "movement-saved", "movement-saved"]
        assert [item["data"]["version"] for item in items[1:]] == [2, 1]

    def test_one_reads_it_newest_first_page_by_page_and_only_ones_own(self, cloud: Cloud) -> None:
        anna, bert = cloud.sign_in("anna"), cloud.sign_in("bert")
        chain = cloud.functions.audit_log
        for number in range(25):
            cloud.run(chain.record(anna.account, "even" if number % 2 == 0 else "odd", WHO, on=f"d{number % 5}"))
        seen: list[int] = []
        cursor = None
        while True:
            query = {"limit": 4, "event": "even"} | ({"cursor": cursor} if cursor else {})
            page = anna.get("/accounts/me/audit", params=query).json()
            seen += [item["seq"] for item in page["items"]]
            cursor = page["cursor"]
            if cursor is None:
                break
        assert len(seen) == 13
        assert seen == sorted(seen, reverse=True)
        assert kinds(anna, target="d3", event="odd") == ["odd", "odd", "odd"]
        assert kinds(anna, to=1) == []
        assert not {"even", "odd"} & set(kinds(bert))
        for cursor in ("x", "-1", "9" * 13, "\u0661"):
            problem(anna.get("/accounts/me/audit", params={"cursor": cursor}), 422, "cursor-invalid")

    def test_the_same_refusal_again_and_again_is_recorded_once_in_a_while(self, open_cloud: OpenCloud) -> None:
        clock = MovingClock()
        cloud = open_cloud(clock=clock)
        for _ in range(5):
            cloud.run(cloud.functions.audit_log.record_rejection(OWNER, "sign-in-refused", None, address="192.0.2.1"))
        clock.advance(11)
        cloud.run(cloud.functions.audit_log.record_rejection(OWNER, "sign-in-refused", None, address="192.0.2.1"))
        head = cloud.run(cloud.functions.audit_reader.head(OWNER))
        assert head is not None
        assert head.seq == 2


def test_what_is_sent_again_since_its_answer_was_lost_is_recorded_once(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store's client asks again by itself; not every store knows what it has done already."""
    functions = cloud.functions
    batch = functions.tables.batch
    lost: list[str] = []

    async def losing(table: str, writes: Any) -> Any:
        done = await batch(table, writes)
        if table == store.AUDIT:
            lost.append(table)
            if len(lost) % 2:
                raise Conflict("it is not as the writer believed")
        return done

    monkeypatch.setattr(functions.tables, "batch", losing)

    async def work() -> list[str]:
        async with functions.audit_log.change(OWNER, "changed", WHO) as change:
            await change.noted()
        await asyncio.gather(*(functions.audit_log.record(OWNER, f"did {number}", WHO) for number in range(3)))
        told = entry("told", WHO, entry_id="told", at_ms=functions.clock.now_ms())
        for _ in range(2):
            await functions.audit_log.append_all(OWNER, [told])
        return [record["what"] for record in await everything(functions)]

    assert sorted(cloud.run(work())) == ["changed", "did 0", "did 1", "did 2", "told"]
    assert len(lost) > 2
    assert verdict(cloud, OWNER) == ""


def test_the_timer_notes_the_head_elsewhere_every_hour_with_something_new(cloud: Cloud) -> None:
    clock = cloud.clock
    chain, blobs = cloud.functions.audit_log, cloud.functions.blobs

    def noted() -> int:
        return (cloud.run(blobs.get(anchors(OWNER))) or b"").count(b"\n")

    for expected in (1, 2):
        cloud.run(chain.record(OWNER, "did", WHO))
        cloud.run(chain.record(OWNER, "did", WHO))
        clock.advance(ANCHOR_MS / 1000)
        cloud.sweep()
        assert noted() == expected
    clock.advance(ANCHOR_MS / 1000)
    cloud.sweep()
    assert noted() == 2
    assert cloud.run(cloud.functions.audit_reader.verify(OWNER)).anchors == 2
