"""Contract of ``Tables``. The test of an adapter inherits the class and supplies the fixtures.

``tables``: an empty store. ``again``: opens another instance over the same store, as another process would.
"""

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import pytest

from function_app.ports.tables import (
    MAX_BATCH,
    MAX_BATCH_BYTES,
    MAX_DATA_BYTES,
    MAX_KEY_LENGTH,
    SCHEMA,
    Conflict,
    Row,
    Tables,
    Write,
)

Again = Callable[[], Tables]

KEYS = (
    "a/b", "a\\b", "a#b", "a?b", "a\tb", "a\nb", "a%2Fb", "a+b", " a ", "a'b", 'a"b', "a;b", "a\x00b", "\x7f", "\x85",
    "ä", "a\u0308", "ЖЖ", "日本", "🤖", "🤖🦾", "\uffff", "\U0010ffff", ".", "..", "~", "-", "_", "A", "a", "0",
    "Z" * MAX_KEY_LENGTH, "🤖" * MAX_KEY_LENGTH, "ü" * MAX_KEY_LENGTH,
)  # fmt: skip
HOSTILE = (
    "' OR '1'='1", "x' or PartitionKey ne 'x", "'; DROP TABLE rows; --", '" OR ""="', "%", "_", "*", "a' AND 1=1 --",
    "${jndi:ldap://x}", "{{7*7}}", "\\x00", "NULL",
)  # fmt: skip
INVALID_KEYS = ("", "x" * (MAX_KEY_LENGTH + 1), "🤖" * (MAX_KEY_LENGTH + 1), "\ud800", "a\udfff")
DATA: dict[str, Any] = {
    "text": "grüß 🤖 \x00 \u2028",
    "int": 2**53,
    "negative": -(2**53),
    "float": 0.1,
    "yes": True,
    "none": None,
    "list": [1, "two", [3.5, {"four": None}]],
    "object": {"": {}, "a.b/c": []},
}
ROUNDS = 10


class TablesSuite:
    """Every port method, at its limits."""

    pytestmark = pytest.mark.anyio

    async def test_a_created_row_is_read_back_with_its_etag_only_from_its_own_key(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k", DATA))
        assert (row.partition, row.key, row.data) == ("p", "k", DATA)
        assert row.etag
        assert await tables.get("T", "p", "k") == row
        for place in (("T", "p", "K"), ("T", "P", "k"), ("U", "p", "k"), ("T", "k", "p")):
            assert await tables.get(*place) is None
        others = [await tables.create(table, Row(partition, "k")) for table, partition in (("T", "q"), ("U", "p"))]
        assert (await tables.query("T", "p")).rows == (row,)
        assert (await tables.query("T", "q")).rows == (others[0],)
        assert (await tables.query("U", "p")).rows == (others[1],)

    async def test_a_row_is_created_once(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k", {"n": 1}))
        with pytest.raises(Conflict):
            await tables.create("T", Row("p", "k", {"n": 2}))
        assert await tables.get("T", "p", "k") == row

    async def test_replace_and_delete_require_the_current_etag(self, tables: Tables) -> None:
        async def refuse(*etags: str) -> None:
            for etag in etags:
                row = Row("p", "k", {"n": 3}, etag)
                for call in (tables.replace("T", row), tables.delete("T", row)):
                    with pytest.raises(Conflict):
                        await call

        await refuse("", "*", "abc")
        assert await tables.get("T", "p", "k") is None
        first = await tables.create("T", Row("p", "k", {"n": 1}))
        second = await tables.replace("T", Row("p", "k", {"n": 2}, first.etag))
        await refuse(first.etag, "", "*", "1", second.etag + " ")
        assert await tables.get("T", "p", "k") == second
        await tables.delete("T", second)
        assert await tables.get("T", "p", "k") is None
        await refuse(second.etag)

    async def test_a_change_keeps_other_fields_and_the_schema_version_of_a_newer_server(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k", DATA, schema=SCHEMA + 1))
        assert row == await tables.get("T", "p", "k")
        await tables.batch("T", [Write("replace", row.changed({"int": 1}))])
        changed = await tables.get("T", "p", "k")
        assert changed is not None
        assert (changed.data, changed.schema) == ({**DATA, "int": 1}, SCHEMA + 1)

    async def test_each_write_has_a_new_etag(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k", {"n": 1}))
        same_data = await tables.replace("T", row)
        await tables.delete("T", same_data)
        created_again = await tables.create("T", Row("p", "k", {"n": 1}))
        assert len({row.etag, same_data.etag, created_again.etag}) == 3

    # ------------------------------------------------------------ keys

    async def test_any_text_is_a_partition_and_a_key(self, tables: Tables) -> None:
        for key in KEYS:
            row = await tables.create("T", Row(key, key, {"n": 1}))
            assert await tables.get("T", key, key) == row
            assert (await tables.query("T", key)).rows == (row,)
            assert (await tables.query("T", key, first=key, limit=1)).rows == (row,)
            row = await tables.replace("T", row)
            (row,) = await tables.batch("T", [Write("replace", row)])
            await tables.delete("T", row)
            assert (await tables.query("T", key)).rows == ()

    async def test_similar_keys_differ_and_sort_by_their_utf_8_bytes(self, tables: Tables) -> None:
        rows = {key: await tables.create("T", Row("p", key, {"key": key})) for key in KEYS}
        for key, row in rows.items():
            assert await tables.get("T", "p", key) == row
        ordered = [rows[key] for key in sorted(KEYS, key=str.encode)]
        assert list((await tables.query("T", "p")).rows) == ordered
        assert [row async for row in all_rows(tables, limit=3)] == ordered

    async def test_text_that_looks_like_a_query_is_only_a_key(self, tables: Tables) -> None:
        for key in ("one", "two"):
            await tables.create("T", Row("p", key))
        for text in HOSTILE:
            assert await tables.get("T", "p", text) is None
            assert await tables.get("T", text, "one") is None
            assert (await tables.query("T", text)).rows == ()
            assert (await tables.query("T", "p", first=text, last=text)).rows == ()
            row = await tables.create("T", Row(text, text, {"n": 1}))
            assert (await tables.query("T", text)).rows == (row,)
            with pytest.raises(Conflict):
                await tables.replace("T", Row("p", "one", {}, text))
        assert len((await tables.query("T", "p")).rows) == 2

    async def test_an_invalid_key_is_rejected_and_nothing_is_written(self, tables: Tables) -> None:
        for text in INVALID_KEYS:
            for row in (Row(text, "k"), Row("p", text)):
                for call in (tables.create("T", row), tables.batch("T", [Write("create", row)])):
                    with pytest.raises(ValueError, match="partitions and keys"):
                        await call
        assert (await tables.query("T", "p")).rows == ()

    # ------------------------------------------------------------ size

    async def test_a_row_holds_256_kb_at_most(self, tables: Tables) -> None:
        room = MAX_DATA_BYTES - len('{"text":""}')
        row = await tables.create("T", Row("p", "k", {"text": "x" * room}))
        assert await tables.get("T", "p", "k") == row
        too_large = Row("p", "k", {"text": "x" * (room + 1)}, row.etag)
        for call in (
            tables.create("T", Row("p", "other", too_large.data)),
            tables.create("T", Row("p", "other", {"text": "🤖" * (MAX_DATA_BYTES // 4)})),
            tables.replace("T", too_large),
            tables.batch("T", [Write("create", Row("p", "first")), Write("replace", too_large)]),
        ):
            with pytest.raises(ValueError, match="262144"):
                await call
        assert (await tables.query("T", "p")).rows == (row,)

    # ------------------------------------------------------------ query

    @pytest.mark.parametrize(
        ("bounds", "expected"),
        [
            ({}, "a aa b ba c ä"),
            ({"first": "b"}, "b ba c ä"),
            ({"last": "b"}, "a aa"),
            ({"first": "aa", "last": "c"}, "aa b ba"),
            ({"first": "ab", "last": "ab"}, ""),
            ({"first": "c", "last": "a"}, ""),
            ({"last": ""}, ""),
            ({"first": "z", "last": None}, "ä"),
        ],
        ids=str,
    )
    async def test_a_query_is_bounded_by_first_and_last(
        self, tables: Tables, bounds: dict[str, Any], expected: str
    ) -> None:
        await create_rows(tables, "a", "aa", "b", "ba", "c", "ä")
        assert [row.key for row in (await tables.query("T", "p", **bounds)).rows] == expected.split()

    async def test_paging_returns_every_row_once_in_order(self, tables: Tables) -> None:
        keys = [f"k{number:03d}" for number in range(130)]
        for start in range(0, len(keys), MAX_BATCH):
            await create_rows(tables, *keys[start : start + MAX_BATCH])
        for limit in (60, 1000):
            assert [row.key async for row in all_rows(tables, limit=limit)] == keys
        assert [row.key async for row in all_rows(tables, limit=7, first="k100", last="k125")] == keys[100:125]
        assert len((await tables.query("T", "p")).rows) == 100

    async def test_a_page_that_ends_with_the_last_row_has_no_cursor(self, tables: Tables) -> None:
        await create_rows(tables, *"abcd")
        assert (await tables.query("T", "p", limit=4)).cursor is None
        page = await tables.query("T", "p", limit=2)
        page = await tables.query("T", "p", limit=2, cursor=page.cursor)
        assert ([row.key for row in page.rows], page.cursor) == (["c", "d"], None)

    async def test_paging_continues_while_rows_are_created_and_deleted(self, tables: Tables) -> None:
        rows = await create_rows(tables, *"acegi")
        page = await tables.query("T", "p", limit=2)
        for row in (rows[0], rows[2]):
            await tables.delete("T", row)
        await create_rows(tables, *"bz")
        assert [row.key async for row in all_rows(tables, limit=2, cursor=page.cursor)] == ["g", "i", "z"]

    async def test_a_cursor_does_not_widen_the_bounds(self, tables: Tables) -> None:
        await create_rows(tables, "a1", "a2", "b1", "b2")
        early, late = [(await tables.query("T", "p", limit=limit)).cursor for limit in (1, 3)]
        assert [row.key for row in (await tables.query("T", "p", first="b", cursor=early)).rows] == ["b1", "b2"]
        assert (await tables.query("T", "p", last="b", cursor=late)).rows == ()

    async def test_an_invalid_cursor_or_limit_is_rejected(self, tables: Tables) -> None:
        for cursor in ("§", "a b", "=", "_w", "🤖", "'"):
            with pytest.raises(ValueError, match="cursor"):
                await tables.query("T", "p", cursor=cursor)
        for limit in (0, -1, 1001):
            with pytest.raises(ValueError, match="limit"):
                await tables.query("T", "p", limit=limit)

    # ------------------------------------------------------------ batch

    async def test_a_batch_does_all_its_writes(self, tables: Tables) -> None:
        to_delete, to_replace = await create_rows(tables, "delete", "replace")
        writes = [
            Write("create", Row("p", "create", {"n": 1})),
            Write("delete", to_delete),
            Write("replace", Row("p", "replace", {"n": 2}, to_replace.etag)),
        ]
        created, deleted, replaced = await tables.batch("T", writes)
        assert deleted == to_delete
        assert (await tables.query("T", "p")).rows == (created, replaced)
        assert (created.data, replaced.data) == ({"n": 1}, {"n": 2})

    @pytest.mark.parametrize("kind", ["create", "replace", "delete"])
    async def test_one_conflict_in_a_batch_prevents_all_its_writes(self, tables: Tables, kind: Any) -> None:
        rows = await create_rows(tables, "old0", "old1", "old2")
        for position in (0, 3, 6):
            writes = [Write("create", Row("p", f"new{number}")) for number in range(4)]
            writes[3:3] = [Write("replace", Row("p", "old0", {"n": 9}, rows[0].etag)), Write("delete", rows[1])]
            writes.insert(position, Write(kind, Row("p", "old2", {"n": 9}, "stale")))
            with pytest.raises(Conflict):
                await tables.batch("T", writes)
            assert (await tables.query("T", "p")).rows == rows
        await tables.create("T", Row("p", "after"))

    async def test_a_batch_has_1_to_100_writes_of_one_partition_and_different_keys(self, tables: Tables) -> None:
        writes = [Write("create", Row("p", f"{number:03d}")) for number in range(MAX_BATCH + 1)]
        row = Row("p", "b", {}, "etag")
        for wrong, message in (
            ([], "1 to 100"),
            (writes, "1 to 100"),
            ([Write("create", Row("p", "a")), Write("create", Row("q", "b"))], "one partition"),
            ([Write("create", row), Write("create", row)], "each key once"),
            ([Write("delete", row), Write("create", row)], "each key once"),
        ):
            with pytest.raises(ValueError, match=message):
                await tables.batch("T", wrong)
        assert (await tables.query("T", "p")).rows == ()
        assert len(await tables.batch("T", writes[:MAX_BATCH])) == MAX_BATCH

    async def test_a_batch_holds_1_mb_of_data_at_most(self, tables: Tables) -> None:
        text = "x" * (MAX_BATCH_BYTES // 5 - len('{"text":""}'))
        rows = [Row("p", str(number), {"text": text}) for number in range(5)]
        written = await tables.batch("T", [Write("create", row) for row in rows])
        assert (await tables.query("T", "p")).rows == written
        too_large = [Write("replace", row) for row in written[:-1]]
        too_large.append(Write("replace", Row("p", "4", {"text": text + "y"}, written[-1].etag)))
        with pytest.raises(ValueError, match=str(MAX_BATCH_BYTES)):
            await tables.batch("T", too_large)
        assert (await tables.query("T", "p")).rows == written
        deletions = [Write("delete", row) for row in written]  # they do not count
        await tables.batch("T", [*deletions, *(Write("create", Row("p", f"new {row.key}", row.data)) for row in rows)])
        assert [row.key for row in (await tables.query("T", "p")).rows] == [f"new {number}" for number in range(5)]

    # ------------------------------------------------------------ instances

    async def test_another_instance_sees_every_write_immediately(self, tables: Tables, again: Again) -> None:
        other = again()
        for number in range(ROUNDS):
            row = await tables.create("T", Row("p", str(number), {"n": number}))
            assert await other.get("T", "p", str(number)) == row
            row = await other.replace("T", row)
            assert await tables.get("T", "p", str(number)) == row
        assert await tables.query("T", "p") == await other.query("T", "p")

    async def test_one_of_many_writers_with_the_same_etag_wins(self, tables: Tables, again: Again) -> None:
        instances = [tables, again(), again()]
        row = await tables.create("T", Row("p", "k", {"n": -1}))
        for _ in range(3):
            writes = [
                instance.replace("T", Row("p", "k", {"n": number}, row.etag))
                for number in range(3)
                for instance in instances
            ]
            results = await asyncio.gather(*writes, return_exceptions=True)
            (row,) = [result for result in results if isinstance(result, Row)]
            assert sum(isinstance(result, Conflict) for result in results) == len(results) - 1
            assert await instances[2].get("T", "p", "k") == row

    async def test_concurrent_instances_lose_no_write(self, tables: Tables, again: Again) -> None:
        instances = [tables, again(), again()]
        await tables.create("T", Row("p", "count", {"n": 0}))

        async def race(instance: Tables) -> list[str]:
            created = []
            for number in range(ROUNDS):
                with contextlib.suppress(Conflict):
                    created.append((await instance.create("T", Row("p", f"row{number}"))).key)
                with contextlib.suppress(Conflict):
                    writes = [Write("create", Row("q", f"{name}{number}")) for name in ("batch", "single")]
                    created.append((await instance.batch("T", writes))[0].key)
                await count_up(instance)
            return created

        created = await asyncio.gather(*(race(instance) for instance in instances))
        expected = sorted(f"{kind}{number}" for kind in ("row", "batch") for number in range(ROUNDS))
        assert sorted(key for keys in created for key in keys) == expected
        count = await tables.get("T", "p", "count")
        assert count is not None
        assert count.data == {"n": len(instances) * ROUNDS}

    async def test_it_may_be_closed_twice_and_used_again(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k"))
        await tables.close()
        await tables.close()
        assert await tables.get("T", "p", "k") == row


async def count_up(tables: Tables) -> None:
    """Add one to a counter, as often as it takes."""
    while True:
        row = await tables.get("T", "p", "count")
        assert row is not None
        with contextlib.suppress(Conflict):
            await tables.replace("T", Row("p", "count", {"n": row.data["n"] + 1}, row.etag))
            return


async def create_rows(tables: Tables, *keys: str) -> tuple[Row, ...]:
    """New rows with these keys in partition ``p``."""
    return await tables.batch("T", [Write("create", Row("p", key)) for key in keys])


async def all_rows(tables: Tables, *, limit: int, cursor: str | None = None, **bounds: str | None) -> Any:
    """Every row of partition ``p``, page by page."""
    while True:
        page = await tables.query("T", "p", limit=limit, cursor=cursor, **bounds)  # type: ignore[arg-type]
        assert len(page.rows) <= limit
        for row in page.rows:
            yield row
        cursor = page.cursor
        if cursor is None:
            return
