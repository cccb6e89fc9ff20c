"""The chain of who did what: what is recorded, by whom it can be read, and that nobody changes it unseen."""

import asyncio
import itertools
import json
import sqlite3
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from function_app.__main__ import main
from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import CLOUD, Head, entry
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import Conflict
from function_app.services.audit.audit_log import ABANDON_MS, ANCHOR_MS, LOOK_MS, anchors
from function_app.services.storage import records as store
from tests.harness.cloud.cloud import API, Cloud, MovingClock, Person, problem, settings
from tests.harness.processes import Place, begin, killed, open_functions, run_here, show_code
from tests.integration.functions.conftest import Open

OWNER = "owner"
WHO = Identity(OWNER, "anna", "s")


def kinds(person: Person, **query: Any) -> list[str]:
    answer = person.get("/accounts/me/audit", params=query)
    assert answer.status_code == 200, answer.text
    return [record["event"] for record in answer.json()["items"]]


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
        for name in ("anna", "nobody", "anna"):
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
        assert after.seq == before.seq + 2, "of a name that nobody has, and of a link"
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

    def test_the_same_refusal_again_and_again_is_recorded_once_in_a_while(self, open_cloud: Open) -> None:
        clock = MovingClock()
        cloud = open_cloud(clock=clock)
        for _ in range(5):
            cloud.run(cloud.functions.audit_log.record_rejection(OWNER, "sign-in-refused", None, address="192.0.2.1"))
        clock.advance(11)
        cloud.run(cloud.functions.audit_log.record_rejection(OWNER, "sign-in-refused", None, address="192.0.2.1"))
        head = cloud.run(cloud.functions.audit_reader.head(OWNER))
        assert head is not None
        assert head.seq == 2


# ---------------------------------------------------------------- changed by somebody who has the tables in hand


@pytest.fixture(scope="class")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Cloud, sqlite3.Connection, Head]]:
    """A chain of ten records, noted in the blob store at the fifth; and the database below."""
    home = tmp_path_factory.mktemp("home")
    with Cloud(settings(home), clock=MovingClock()) as cloud:

        async def write() -> None:
            for number in range(10):
                data: dict[str, Any] = {"n": number, "text": 'ä"\\', "deep": {"list": [1, 2.5, None, True]}}
                await cloud.functions.audit_log.record(OWNER, "did", WHO, on=f"d{number}", **data)
                if number == 4:
                    await cloud.functions.audit_log.anchor(OWNER)
            await cloud.functions.audit_log.record("other", "did", WHO, on="d1")

        cloud.run(write())
        head = cloud.run(cloud.functions.audit_reader.head(OWNER))
        assert head is not None
        with sqlite3.connect(home / "tables.sqlite", isolation_level=None) as db:
            db.execute("PRAGMA busy_timeout=5000")
            yield cloud, db, head
        db.close()


Rows = dict[str, bytes]


def rows_of(db: sqlite3.Connection, chain: str = OWNER) -> Rows:
    found = db.execute("SELECT key, data FROM rows WHERE tab='Audit' AND part=?", (chain,)).fetchall()
    return {key: bytes(data) for key, data in found if not key.startswith("once:")}


def put(db: sqlite3.Connection, rows: Rows) -> None:
    db.execute("BEGIN")
    db.execute("DELETE FROM rows WHERE tab='Audit' AND part=?", (OWNER,))
    db.executemany(
        "INSERT INTO rows (tab, part, key, etag, data) VALUES ('Audit', ?, ?, 'x', ?)",
        [(OWNER, key, data) for key, data in rows.items()],
    )
    db.execute("COMMIT")


def key(seq: int) -> str:
    return f"record:{seq:012d}"


Written = tuple[Cloud, sqlite3.Connection, Head]


class TestChanged:
    def check(self, written: Written, rows: Rows, *expected: Head) -> str:
        cloud, db, _ = written
        whole = rows_of(db)
        put(db, rows)
        try:
            return verdict(cloud, OWNER, *expected)
        finally:
            put(db, whole)

    def test_as_it_was_written_it_is_whole(self, written: Written) -> None:
        _, db, head = written
        assert self.check(written, rows_of(db), head) == ""

    @pytest.mark.parametrize("seq", range(1, 11))
    def test_a_deleted_record_is_found(self, written: Written, seq: int) -> None:
        rows = rows_of(written[1])
        del rows[key(seq)]
        assert f"record {seq}:" in self.check(written, rows)

    def test_each_changed_field_is_found_where_it_is(self, written: Written) -> None:
        rows = rows_of(written[1])
        for name in [*rows]:
            record = json.loads(rows[name])
            for field, value in record.items():
                other = value + 1 if isinstance(value, int) else "x" if isinstance(value, str) else {"n": 99}
                for changed in (
                    {**record, field: other},
                    {known: kept for known, kept in record.items() if known != field},
                    {**record, field: None},
                    {**record, "more": 1},
                ):
                    said = self.check(written, {**rows, name: json.dumps(changed).encode()})
                    place = f"record {int(name.rpartition(':')[2])}" if name != "head" else ""
                    assert said, f"{name} {field}"
                    assert place in said or field == "seq"

    def test_each_changed_byte_of_a_record_and_of_the_head_is_found(self, written: Written) -> None:
        rows = rows_of(written[1])
        found = 0
        for name in (key(3), "head"):
            text = rows[name]
            for place, bit in itertools.product(range(len(text)), (0,)):
                changed = bytearray(text)
                changed[place] ^= 1 << bit
                try:
                    same = json.loads(bytes(changed)) == json.loads(text)
                except ValueError:
                    continue  # the store itself says that this is no row
                if not same:
                    assert self.check(written, {**rows, name: bytes(changed)}), changed
                    found += 1
        assert found > 200

    def test_swapped_inserted_doubled_and_anothers_records_are_found(self, written: Written) -> None:
        rows = rows_of(written[1])
        swapped = {**rows, key(4): rows[key(5)], key(5): rows[key(4)]}
        assert "record 4:" in self.check(written, swapped)
        again = {**rows, key(11): rows[key(10)]}
        assert "behind the head" in self.check(written, again)
        shifted = {key(seq + 1): rows[key(seq)] for seq in range(4, 11)}
        inserted = {**rows, **shifted, key(4): rows[key(3)]}
        assert "record 4:" in self.check(written, inserted)
        others = rows_of(written[1], "other")
        assert "record 1:" in self.check(written, {**rows, key(1): others[key(1)]})
        assert self.check(written, others), "another account's chain does not stand in"

    def test_a_head_that_is_forged_or_gone_is_found(self, written: Written) -> None:
        rows = rows_of(written[1])
        head = json.loads(rows["head"])
        cut = {name: data for name, data in rows.items() if name != key(10)}
        forged = {**head, "seq": 9, "hash": json.loads(rows[key(9)])["hash"]}
        assert "signature" in self.check(written, {**cut, "head": json.dumps(forged).encode()})
        unknown = {**forged, "key": "0" * 16}
        assert "none of this cloud's" in self.check(written, {**cut, "head": json.dumps(unknown).encode()})
        del rows["head"]
        assert "head is gone" in self.check(written, rows)

    def test_a_chain_cut_back_to_an_old_head_is_found_by_a_head_noted_elsewhere(
        self, tmp_path: Path, written: Written
    ) -> None:
        """With its own signed head of then it is a whole chain: only what was noted elsewhere knows better."""
        _, _, head = written
        assert "record 1: it and all after it are gone" in self.check(written, {}), "the blob store knows of five"
        with Cloud(settings(tmp_path)) as cloud:
            chain, trail = cloud.functions.audit_log, cloud.functions.audit_reader
            for _ in range(3):
                cloud.run(chain.record(OWNER, "did", WHO))
            with sqlite3.connect(tmp_path / "tables.sqlite", isolation_level=None) as other:
                old = rows_of(other)
                for _ in range(3):
                    cloud.run(chain.record(OWNER, "did", WHO))
                newest = cloud.run(trail.head(OWNER))
                assert newest is not None
                put(other, old)
            other.close()
            assert verdict(cloud, OWNER) == "", "this is why there are anchors"
            assert "record 4: it and all after it are gone" in verdict(cloud, OWNER, newest)
            cloud.run(cloud.functions.blobs.append(anchors(OWNER), f'{{"seq":6,"hash":"{newest.hash}"}}\n'.encode()))
            assert "record 4: it and all after it are gone" in verdict(cloud, OWNER)
        assert head.seq == 10

    def test_another_head_than_was_noted_is_found(self, written: Written) -> None:
        cloud, _, head = written
        assert "another one was noted" in verdict(cloud, OWNER, Head(7, "0" * 64))
        assert "two different heads" in verdict(cloud, OWNER, Head(5, "0" * 64))
        assert verdict(cloud, OWNER, head) == ""


def test_what_is_sent_again_since_its_answer_was_lost_is_recorded_once(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store's client asks again by itself; not every store knows what it has done already."""
    with Cloud(settings(home)) as cloud:
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


def test_the_timer_notes_the_head_elsewhere_every_hour_with_something_new(home: Path) -> None:
    clock = MovingClock()
    with Cloud(settings(home), clock=clock) as cloud:
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


def test_the_command_says_ok_or_names_the_first_broken_record(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TELESCOPE_HOME", str(home))
    with Cloud(settings(home)) as cloud:
        anna = cloud.sign_in("anna")
        for number in range(3):
            cloud.run(cloud.functions.audit_log.record(anna.account, "did", WHO, n=number))
        head = cloud.run(cloud.functions.audit_reader.head(anna.account))
    assert main(["audit", "verify"]) == 0
    assert f"OK {anna.account} {head}" in capsys.readouterr().out
    assert main(["audit", "head", "--account", "anna"]) == 0
    assert capsys.readouterr().out == f"{anna.account} {head}\n"
    assert main(["audit", "verify", "--account", "anna", "--expect", str(head)]) == 0
    assert main(["audit", "verify", "--account", "anna", "--expect", f"9:{'0' * 64}"]) == 1
    assert "are gone" in capsys.readouterr().out
    assert main(["audit", "verify", "--account", "anna", "--expect", "x"]) == 2
    assert main(["audit", "verify", "--expect", str(head)]) == 2
    with sqlite3.connect(home / "tables.sqlite", isolation_level=None) as db:
        db.execute("DELETE FROM rows WHERE tab='Audit' AND part=? AND key=?", (anna.account, key(2)))
    db.close()
    capsys.readouterr()
    assert main(["audit", "verify"]) == 1
    assert f"BROKEN {anna.account} record 2:" in capsys.readouterr().out


# ---------------------------------------------------------------- many writers, and writers that are killed

WRITERS = 4


async def write_many(functions: Functions, writer: int, records: int) -> None:
    for number in range(0, records, 5):
        await asyncio.gather(
            *(functions.audit_log.record(OWNER, "did", WHO, on=f"{writer}-{number + more}") for more in range(5))
        )


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


async def later(functions: Functions) -> None:
    """What the timer does once its time has come."""
    clock: Any = functions.clock
    for seconds in (2 * LOOK_MS / 1000 + 1, ABANDON_MS / 1000 + 1, 2 * LOOK_MS / 1000 + 1):
        clock.advance(seconds)
        await functions.scheduler.run_due_jobs()


@pytest.mark.parametrize(("place", "records"), [("local", 20), ("azure", 5)], indirect=["place"])
def test_of_processes_that_write_at_the_same_time_nothing_is_lost_and_the_chain_does_not_fork(
    place: Place, records: int
) -> None:
    see_one_chain(place, records)


def see_one_chain(place: Place, records: int) -> None:
    writing = [begin(place, write_many, writer, records) for writer in range(WRITERS)]
    for process in writing:
        assert not killed(process)

    async def look(functions: Functions) -> None:
        await later(functions)
        found = Counter(record["on"] for record in await everything(functions))
        assert found == {f"{writer}-{number}": 1 for writer in range(WRITERS) for number in range(records)}
        assert (await functions.audit_reader.verify(OWNER)).broken == ""

    run_here(place, look)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "records"), [("local", 1_000), ("azure", 50), ("aws", 50)], indirect=["place"])
def test_of_processes_that_write_for_long_nothing_is_lost_and_the_chain_does_not_fork(
    place: Place, records: int
) -> None:
    see_one_chain(place, records)


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_killed_at_many_steps_no_change_is_without_its_record(place: Place) -> None:
    see_that_all_is_recorded(place, stride=13)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("place", ["local", "azure", "aws"], indirect=True)
def test_killed_at_any_step_no_change_is_without_its_record(place: Place) -> None:
    see_that_all_is_recorded(place, stride=1)


def see_that_all_is_recorded(place: Place, *, stride: int) -> None:
    """The tables say what was changed; the chain has each of it, once, in the words of who did it or as unknown."""

    async def prepare(functions: Functions, step: int) -> tuple[str, str, str]:
        # Somebody else each time: who is killed while claiming has used up one of their few tries.
        account = await functions.sign_in.account(f"anna {step}")
        agent, code = await show_code(functions)
        return account.id, agent, code

    ends = 0
    for step in itertools.count(1, stride):
        account, agent, code = run_here(place, lambda functions, step=step: prepare(functions, step))  # type: ignore[misc]
        who = Identity(account, "anna", "s")
        before = run_here(place, lambda functions, chain=account: everything(functions, chain))  # type: ignore[misc]
        process = begin(place, _changes, who, agent, code, dies_at=step)
        died = killed(process)

        async def look(functions: Functions, known: int = len(before), who: Identity = who, agent: str = agent) -> None:
            await later(functions)
            records = (await everything(functions, who.account))[known:]
            told = Counter((each["what"], each["data"].get("epoch")) for each in records)
            assert all(count == 1 for count in told.values()), told
            row = await functions.tables.get(store.AGENTS, agent, "agent")
            assert row is not None
            kinds = [what for what, _ in told]
            pairings = bool(row.data["account"]) or bool(row.data["leaving"]) or "agent-unpaired" in kinds
            assert not pairings or "agent-claimed" in kinds
            lease = await functions.tables.get(store.CONTROL, f"{agent}-arm", "now:lease")
            for epoch in range(1, 1 + (lease.data["epoch"] if lease else 0)):
                assert epoch in {number for _, number in told}, f"epoch {epoch} of {told}"
            assert not (await functions.tables.query(store.AUDIT, who.account, first="wait:", last="wait;")).rows
            assert (await functions.audit_reader.verify(who.account)).broken == ""

        run_here(place, look)
        if not died:
            ends += 1
            break
    assert ends == 1


async def _changes(functions: Functions, who: Identity, agent: str, code: str) -> None:
    await functions.claim.claim(who, code, None)
    device = f"{agent}-arm"
    lease, _ = await functions.leases.acquire(who, device, epoch=None, lease_ms=60_000, wait_ms=0)
    await functions.leases.release(who, device, epoch=lease.epoch)
    await functions.leases.acquire(who, device, epoch=None, lease_ms=60_000, wait_ms=0)
    await functions.unpair.unpair(who, agent)


def test_what_cannot_be_noted_is_not_done(tmp_path: Path) -> None:
    """Without the tables nothing changes: the note is the first write."""
    place = Place({"TELESCOPE_HOME": str(tmp_path)}, 1_800_000_000_000, tmp_path / "sent")

    async def look() -> None:
        functions = open_functions(place)
        account = await functions.sign_in.account("anna")
        who = Identity(account.id, "anna", "s")
        agent, code = await show_code(functions)
        create = functions.tables.create

        async def refuse(table: str, row: Any) -> Any:
            if table == store.AUDIT and row.key.startswith("wait:"):
                raise store_down()
            return await create(table, row)

        functions.tables.create = refuse  # type: ignore[method-assign]
        with pytest.raises(type(store_down())):
            await functions.claim.claim(who, code, None)
        row = await functions.tables.get(store.AGENTS, agent, "agent")
        assert row is not None
        assert row.data["account"] is None
        await functions.close()

    asyncio.run(look())


def store_down() -> Exception:
    from function_app.ports.tables import StoreError

    return StoreError("gone")
