"""The audit log with several processes that write, and processes that are killed."""

import asyncio
import itertools
import sqlite3
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from function_app.__main__ import main
from function_app.bootstrap import Functions
from function_app.domain.audit.hash_chain import Head
from function_app.domain.identity.accounts import Identity
from function_app.services.audit.audit_log import ABANDON_MS, LOOK_MS
from function_app.services.storage import records as store
from tests.harness.cloud.cloud import Cloud, Person, settings
from tests.harness.processes import Place, begin, killed, open_functions, run_here, show_code

OWNER = "owner"
WHO = Identity(OWNER, "anna", "s")


def kinds(person: Person, **query: Any) -> list[str]:
    answer = person.get("/accounts/me/audit", params=query)
    assert answer.status_code == 200, answer.text
    return [record["event"] for record in answer.json()["items"]]


def key(seq: int) -> str:
    return f"record:{seq:012d}"


def verdict(cloud: Cloud, chain: str, *expected: Head) -> str:
    return cloud.run(cloud.functions.audit_reader.verify(chain, expected=expected)).broken


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
        # A new person each time: a killed claim uses up one of the few attempts.
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
