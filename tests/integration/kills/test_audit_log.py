"""The audit log with several processes that write, and processes that are killed."""

import asyncio
import sqlite3
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from function_app.__main__ import main
from function_app.bootstrap import Functions
from function_app.domain.identity.accounts import Identity
from function_app.ports.tables import StoreError
from function_app.services.audit.audit_log import ABANDON_MS, CHECK_MS
from function_app.services.storage import records as store
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.processes import Place, begin, kill, killed, run_here, show_code
from tests.harness.stores.emulators import STORES
from tests.integration.kills.scenes import rows_of

OWNER = "owner"
WHO = Identity(OWNER, "anna", "s")


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
    assert "are missing" in capsys.readouterr().out
    assert main(["audit", "verify", "--account", "anna", "--expect", "x"]) == 2
    assert main(["audit", "verify", "--expect", str(head)]) == 2
    with sqlite3.connect(home / "tables.sqlite", isolation_level=None) as db:
        db.execute("DELETE FROM rows WHERE tab='Audit' AND part=? AND key=?", (anna.account, f"record:{2:012d}"))
    db.close()
    capsys.readouterr()
    assert main(["audit", "verify"]) == 1
    assert f"BROKEN {anna.account} record 2:" in capsys.readouterr().out


WRITERS = 4
MOST_STEPS = 200
LONG = pytest.mark.long


async def write_many(functions: Functions, writer: int, records: int) -> None:
    for number in range(0, records, 5):
        await asyncio.gather(
            *(functions.audit_log.record(OWNER, "did", WHO, on=f"{writer}-{number + more}") for more in range(5))
        )


async def chain_records(functions: Functions, chain: str = OWNER) -> list[dict[str, Any]]:
    """All records of a chain."""
    return [row for key, row in (await rows_of(functions, store.AUDIT, chain)).items() if key.startswith("record:")]


async def later(functions: Functions) -> None:
    """Run the timer after all time limits."""
    clock: Any = functions.clock
    for seconds in (2 * CHECK_MS / 1000 + 1, ABANDON_MS / 1000 + 1, 2 * CHECK_MS / 1000 + 1):
        clock.advance(seconds)
        await functions.scheduler.run_due_jobs()


def check_one_chain(place: Place, records: int) -> None:
    writing = [begin(place, write_many, writer, records) for writer in range(WRITERS)]
    for process in writing:
        assert not killed(process)

    async def check_chain(functions: Functions) -> None:
        await later(functions)
        counts = Counter(record["target"] for record in await chain_records(functions))
        assert counts == {f"{writer}-{number}": 1 for writer in range(WRITERS) for number in range(records)}
        assert (await functions.audit_reader.verify(OWNER)).broken == ""

    run_here(place, check_chain)


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_processes_that_write_at_the_same_time_lose_nothing_and_do_not_fork_the_chain(place: Place) -> None:
    check_one_chain(place, 20)


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize(("place", "records"), [("local", 1_000), ("azure", 50), ("aws", 50)], indirect=["place"])
def test_processes_that_write_for_long_lose_nothing_and_do_not_fork_the_chain(place: Place, records: int) -> None:
    check_one_chain(place, records)


@pytest.mark.parametrize("place", ["memory", *(pytest.param(store, marks=LONG) for store in STORES)], indirect=True)
@pytest.mark.timeout(1_800)
def test_a_process_killed_at_any_step_leaves_no_change_without_its_record(place: Place) -> None:
    """The tables show what changed; the chain has one record of each change, by its actor or by an unknown one."""
    for step in range(1, MOST_STEPS):
        account, agent, code = run_here(place, partial(prepare, step=step))
        operator = Identity(account, "anna", "s")
        before = run_here(place, partial(chain_records, chain=account))
        survived = not kill(place, change, operator, agent, code, at=step)
        run_here(place, partial(check_records, operator=operator, agent=agent, before=len(before)))
        if survived:
            return
    pytest.fail(f"more than {MOST_STEPS} steps")


async def prepare(functions: Functions, step: int) -> tuple[str, str, str]:
    """A new person each time, because a killed claim counts as one of the few attempts."""
    account = await functions.sign_in.account(f"anna {step}")
    return account.id, *await show_code(functions)


async def check_records(functions: Functions, operator: Identity, agent: str, before: int) -> None:
    await later(functions)
    records = (await chain_records(functions, operator.account))[before:]
    changes = Counter((each["event"], each["data"].get("epoch")) for each in records)
    assert all(count == 1 for count in changes.values()), changes
    row = await functions.tables.get(store.AGENTS, agent, "agent")
    assert row is not None
    kinds = [kind for kind, _ in changes]
    paired = bool(row.data["account"]) or bool(row.data["leaving"]) or "agent-unpaired" in kinds
    assert not paired or "agent-claimed" in kinds
    lease = await functions.tables.get(store.CONTROL, f"{agent}-arm", "now:lease")
    epochs = set(range(1, 1 + (lease.data["epoch"] if lease else 0)))
    assert epochs <= {epoch for _, epoch in changes}, changes
    assert not (await functions.tables.query(store.AUDIT, operator.account, first="wait:", last="wait;")).rows
    assert (await functions.audit_reader.verify(operator.account)).broken == ""


async def change(functions: Functions, operator: Identity, agent: str, code: str) -> None:
    await functions.claim.claim(operator, code, None)
    device = f"{agent}-arm"
    lease, *_ = await functions.leases.acquire(operator, device, epoch=None, lease_ms=60_000, wait_ms=0)
    await functions.leases.release(operator, device, epoch=lease.epoch)
    await functions.leases.acquire(operator, device, epoch=None, lease_ms=60_000, wait_ms=0)
    await functions.unpair.unpair(operator, agent)


@pytest.mark.parametrize("place", ["memory"], indirect=True)
def test_a_change_that_cannot_be_recorded_is_not_made(place: Place) -> None:
    """The audit record of a change is written first."""

    async def check_chain(functions: Functions) -> None:
        account, agent, code = await prepare(functions, 0)
        create = functions.tables.create

        async def refuse(table: str, row: Any) -> Any:
            if table == store.AUDIT and row.key.startswith("wait:"):
                raise StoreError("gone")
            return await create(table, row)

        functions.tables.create = refuse  # type: ignore[method-assign]
        with pytest.raises(StoreError):
            await functions.claim.claim(Identity(account, "anna", "s"), code, None)
        row = await functions.tables.get(store.AGENTS, agent, "agent")
        assert row is not None
        assert row.data["account"] is None

    run_here(place, check_chain)
