"""Every change of stored audit records is detected."""

import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

from function_app.domain.audit.hash_chain import Head
from function_app.domain.identity.accounts import Identity
from function_app.services.audit.audit_log import anchors
from function_app.services.storage import records
from tests.fakes.tables import MemoryTables
from tests.harness.cloud.cloud import Cloud, settings
from tests.harness.cloud.memory import NO_FOLDER, Memory

OWNER = "owner"
CALLER = Identity(OWNER, "anna", "s")
Rows = dict[str, bytes]


def verdict(cloud: Cloud, *expected: Head) -> str:
    return cloud.run(cloud.functions.audit_reader.verify(OWNER, expected=expected)).broken


def rows_of(tables: MemoryTables, chain: str = OWNER) -> Rows:
    stored = tables.partition(records.AUDIT, chain).rows
    return {key: text for key, (_, text) in stored.items() if not key.startswith("once:")}


def put(tables: MemoryTables, rows: Rows) -> None:
    partition = tables.partition(records.AUDIT, OWNER)
    partition.rows = {key: ("x", text) for key, text in rows.items()}
    partition.keys = sorted(rows)


def key(seq: int) -> str:
    return f"record:{seq:012d}"


class Written(NamedTuple):
    """A chain of ten records, with an anchor at the fifth, and a chain of another account."""

    cloud: Cloud
    tables: MemoryTables
    rows: Rows
    head: Head

    def check(self, rows: Rows, *expected: Head) -> str:
        """Return the verdict on these rows, then restore the original ones."""
        put(self.tables, rows)
        try:
            return verdict(self.cloud, *expected)
        finally:
            put(self.tables, self.rows)


@pytest.fixture(scope="module")
def written() -> Iterator[Written]:
    memory = Memory()
    with Cloud(settings(NO_FOLDER), memory=memory) as cloud:

        async def write() -> Head | None:
            audit_log = cloud.functions.audit_log
            for number in range(10):
                data: dict[str, Any] = {"n": number, "text": 'ä"\\', "deep": {"list": [1, 2.5, None, True]}}
                await audit_log.record(OWNER, "did", CALLER, on=f"d{number}", **data)
                if number == 4:
                    await audit_log.anchor(OWNER)
            await audit_log.record("other", "did", CALLER, on="d1")
            return await cloud.functions.audit_reader.head(OWNER)

        head = cloud.run(write())
        assert head is not None
        yield Written(cloud, memory.tables, rows_of(memory.tables), head)
    memory.loop.end()


def data_of(text: bytes) -> dict[str, Any]:
    """The row without its schema version, which the chain does not cover: it changes no record."""
    return {name: value for name, value in json.loads(text).items() if "schema" not in name}


def test_an_unchanged_chain_is_intact(written: Written) -> None:
    assert written.head.seq == 10
    assert written.check(written.rows, written.head) == ""


@pytest.mark.parametrize("seq", range(1, 11))
def test_deleted_records(written: Written, seq: int) -> None:
    assert f"record {seq}:" in written.check({name: text for name, text in written.rows.items() if name != key(seq)})


def test_changed_fields(written: Written) -> None:
    for name, text in written.rows.items():
        record = json.loads(text)
        place = f"record {int(name.rpartition(':')[2])}" if name != "head" else ""
        for field, value in data_of(text).items():
            other = value + 1 if isinstance(value, int) else "x" if isinstance(value, str) else {"n": 99}
            for changed in (
                {**record, field: other},
                {name: value for name, value in record.items() if name != field},
                {**record, field: None},
                {**record, "more": 1},
            ):
                error = written.check({**written.rows, name: json.dumps(changed).encode()})
                assert error, f"{name} {field}"
                assert place in error or field == "seq"


def test_changed_bytes(written: Written) -> None:
    detected = 0
    for name in (key(3), "head"):
        text = written.rows[name]
        for place in range(len(text)):
            changed = bytearray(text)
            changed[place] ^= 1
            try:
                same = data_of(bytes(changed)) == data_of(text)
            except ValueError:
                continue  # the store cannot read this row
            if not same:
                assert written.check({**written.rows, name: bytes(changed)}), changed
                detected += 1
    assert detected > 200


def test_swapped_inserted_repeated_and_foreign_records(written: Written) -> None:
    rows, check = written.rows, written.check
    assert "record 4:" in check({**rows, key(4): rows[key(5)], key(5): rows[key(4)]})
    assert "newer than the head" in check({**rows, key(11): rows[key(10)]})
    shifted = {key(seq + 1): rows[key(seq)] for seq in range(4, 11)}
    assert "record 4:" in check({**rows, **shifted, key(4): rows[key(3)]})
    foreign = rows_of(written.tables, "other")
    assert "record 1:" in check({**rows, key(1): foreign[key(1)]})
    assert check(foreign), "a chain of another account"


def test_forged_and_missing_heads(written: Written) -> None:
    rows, check = written.rows, written.check
    cut = {name: text for name, text in rows.items() if name != key(10)}
    forged = {**json.loads(rows["head"]), "seq": 9, "hash": json.loads(rows[key(9)])["hash"]}
    assert "signature" in check({**cut, "head": json.dumps(forged).encode()})
    assert "unknown or leaked key" in check({**cut, "head": json.dumps({**forged, "key": "0" * 16}).encode()})
    assert "head is missing" in check({name: text for name, text in rows.items() if name != "head"})
    assert "record 1 and all later ones are missing" in check({}), "the anchor has five records"
    assert "differs from the anchor" in check(rows, Head(7, "0" * 64))
    assert "two different heads" in check(rows, Head(5, "0" * 64))


def test_a_chain_restored_to_an_old_state_contradicts_newer_anchors(cloud: Cloud, memory: Memory) -> None:
    """An old state has a valid signed head: only a head that was recorded elsewhere reveals it."""

    async def write() -> Head | None:
        for _ in range(3):
            await cloud.functions.audit_log.record(OWNER, "did", CALLER)
        return await cloud.functions.audit_reader.head(OWNER)

    cloud.run(write())
    old = rows_of(memory.tables)
    newest = cloud.run(write())
    assert newest is not None
    put(memory.tables, old)
    assert verdict(cloud) == ""
    assert "record 4 and all later ones are missing" in verdict(cloud, newest)
    cloud.run(cloud.functions.blobs.append(anchors(OWNER), f'{{"seq":6,"hash":"{newest.hash}"}}\n'.encode()))
    assert "record 4 and all later ones are missing" in verdict(cloud)
