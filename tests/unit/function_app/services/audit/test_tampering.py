"""Every change of stored audit records is detected."""

import itertools
import json
from collections.abc import Iterator
from typing import Any

import pytest

from function_app.domain.audit.hash_chain import Head
from function_app.domain.identity.accounts import Identity
from function_app.services.audit.audit_log import anchors
from function_app.services.storage import records as store
from tests.fakes.tables import MemoryTables
from tests.harness.cloud.cloud import Cloud, Person, settings
from tests.harness.cloud.memory import NO_FOLDER, Memory

OWNER = "owner"
WHO = Identity(OWNER, "anna", "s")


def kinds(person: Person, **query: Any) -> list[str]:
    answer = person.get("/accounts/me/audit", params=query)
    assert answer.status_code == 200, answer.text
    return [record["event"] for record in answer.json()["items"]]


def verdict(cloud: Cloud, chain: str, *expected: Head) -> str:
    return cloud.run(cloud.functions.audit_reader.verify(chain, expected=expected)).broken


@pytest.fixture(scope="class")
def written() -> Iterator[tuple[Cloud, MemoryTables, Head]]:
    """A chain of ten records, noted in the blob store at the fifth; and the database below."""
    memory = Memory()
    with Cloud(settings(NO_FOLDER), memory=memory) as cloud:

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
        yield cloud, memory.tables, head
    memory.loop.end()


Rows = dict[str, bytes]


def rows_of(tables: MemoryTables, chain: str = OWNER) -> Rows:
    stored = tables.partition(store.AUDIT, chain).rows
    return {key: text for key, (_, text) in stored.items() if not key.startswith("once:")}


def put(tables: MemoryTables, rows: Rows) -> None:
    partition = tables.partition(store.AUDIT, OWNER)
    partition.rows = {key: ("x", text) for key, text in rows.items()}
    partition.keys = sorted(rows)


def key(seq: int) -> str:
    return f"record:{seq:012d}"


Written = tuple[Cloud, MemoryTables, Head]


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
        self, cloud: Cloud, memory: Memory, written: Written
    ) -> None:
        """With its own signed head of then it is a whole chain: only what was noted elsewhere knows better."""
        _, _, head = written
        assert "record 1: it and all after it are gone" in self.check(written, {}), "the blob store knows of five"
        audit_log = cloud.functions.audit_log
        for _ in range(3):
            cloud.run(audit_log.record(OWNER, "did", WHO))
        old = rows_of(memory.tables)
        for _ in range(3):
            cloud.run(audit_log.record(OWNER, "did", WHO))
        newest = cloud.run(cloud.functions.audit_reader.head(OWNER))
        assert newest is not None
        put(memory.tables, old)
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
