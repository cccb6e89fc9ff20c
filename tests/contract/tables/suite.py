"""What every adapter of ``Tables`` promises. An adapter's test inherits the class and brings its fixtures.

``tables``: an empty store. ``again``: opens another instance over the same store, as another process would.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from function_app.ports.tables import (
    MAX_BATCH,
    MAX_BATCH_BYTES,
    MAX_DATA_BYTES,
    MAX_KEY_LENGTH,
    Conflict,
    Row,
    Tables,
    Write,
)

Again = Callable[[], Awaitable[Tables]]

KEYS = (
    "a/b", "a\\b", "a#b", "a?b", "a\tb", "a\nb", "a%2Fb", "a+b", " a ", "a'b", 'a"b', "a;b", "a\x00b", "\x7f",
    "\x85",
    "ä",
    "a\u0308",
    "ЖЖ",
    "日本",
    "🤖",
    "🤖🦾",
    "\uffff",
    "\U0010ffff",
    ".",
    "..",
    "~",
    "-",
    "_",
    "A",
    "a",
    "0",
    "Z" * MAX_KEY_LENGTH,
    "🤖" * MAX_KEY_LENGTH,
    "ü" * MAX_KEY_LENGTH,
)  # fmt: skip
HOSTILE = (
    "' OR '1'='1",
    "x' or PartitionKey ne 'x",
    "'; DROP TABLE rows; --",
    '" OR ""="',
    "%",
    "_",
    "*",
    "a' AND 1=1 --",
    "${jndi:ldap://x}",
    "{{7*7}}",
    "\\x00",
    "NULL",
)
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


class TablesSuite:
    """Every port method, at its limits."""

    pytestmark = pytest.mark.anyio

    async def test_what_was_created_is_read_back_with_its_etag(self, tables: Tables) -> None:
        row = await tables.create("T", Row("p", "k", DATA))
        assert (row.partition, row.key, row.data) == ("p", "k", DATA)
        assert row.etag
        assert await tables.get("T", "p", "k") == row

    async def test_what_is_not_there_is_none(self, tables: Tables) -> None:
        await tables.create("T", Row("p", "k"))
        for place in (("T", "p", "K"), ("T", "P", "k"), ("U", "p", "k"), ("T", "k", "p")):
            assert await tables.get(*place) is None

    async def test_tables_and_partitions_are_apart(self, tables: Tables) -> None:
        for number, (table, partition) in enumerate((("T", "p"), ("T", "q"), ("U", "p"))):
            await tables.create(table, Row(partition, "k", {"n": number}))
        assert [row.data["n"] for row in (await tables.query("T", "p")).rows] == [0]
        assert [row.data["n"] for row in (await tables.query("T", "q")).rows] == [1]
        assert [row.data["n"] for row in (await tables.query("U", "p")).rows] == [2]

    async def test_a_row_is_created_once(self, tables: Tables) -> None:
        await tables.create("T", Row("p", "k", {"n": 1}))
        with pytest.raises(Conflict):
            await tables.create("T", Row("p", "k", {"n": 2}))
        assert await _data(tables, "k") == {"n": 1}

    async def test_replacing_wants_the_etag_that_was_read_last(self, tables: Tables) -> None:
        first = await tables.create("T", Row("p", "k", {"n": 1}))
        second = await tables.replace("T", Row("p", "k", {"n": 2}, first.etag))
        assert second.etag not in ("", first.etag)
        for etag in (first.etag, "", "*", "1", second.etag + " "):
            with pytest.raises(Conflict):
                await tables.replace("T", Row("p", "k", {"n": 3}, etag))
        assert await tables.get("T", "p", "k") == second

    async def test_the_same_data_written_again_has_a_new_etag(self, tables: Tables) -> None:
        first = await tables.create("T", Row("p", "k", {"n": 1}))
        second = await tables.replace("T", first)
        assert second.etag != first.etag

    async def test_a_row_that_was_deleted_and_made_again_has_a_new_etag(self, tables: Tables) -> None:
        first = await tables.create("T", Row("p", "k", {"n": 1}))
        await tables.delete("T", first)
        second = await tables.create("T", Row("p", "k", {"n": 1}))
        assert second.etag != first.etag
        with pytest.raises(Conflict):
            await tables.replace("T", first)
        with pytest.raises(Conflict):
            await tables.delete("T", first)

    async def test_nothing_is_replaced_or_deleted_where_nothing_is(self, tables: Tables) -> None:
        for etag in ("", "*", "abc"):
            with pytest.raises(Conflict):
                await tables.replace("T", Row("p", "k", {}, etag))
            with pytest.raises(Conflict):
                await tables.delete("T", Row("p", "k", {}, etag))
        assert await tables.get("T", "p", "k") is None

    async def test_deleting_wants_the_etag(self, tables: Tables) -> None:
        first = await tables.create("T", Row("p", "k", {"n": 1}))
        second = await tables.replace("T", first)
        for etag in (first.etag, "", "*"):
            with pytest.raises(Conflict):
                await tables.delete("T", Row("p", "k", {}, etag))
        await tables.delete("T", second)
        assert await tables.get("T", "p", "k") is None
        with pytest.raises(Conflict):
            await tables.delete("T", second)

    # ------------------------------------------------------------ keys

    @pytest.mark.parametrize("key", KEYS, ids=lambda key: ascii(key)[:24])
    async def test_any_text_is_a_partition_and_a_key(self, tables: Tables, key: str) -> None:
        row = await tables.create("T", Row(key, key, {"n": 1}))
        assert await tables.get("T", key, key) == row
        assert (await tables.query("T", key)).rows == (row,)
        assert (await tables.query("T", key, first=key, limit=1)).rows == (row,)
        row = await tables.replace("T", row)
        (row,) = await tables.batch("T", [Write("replace", row)])
        await tables.delete("T", row)
        assert (await tables.query("T", key)).rows == ()

    async def test_keys_that_look_alike_are_different(self, tables: Tables) -> None:
        for key in KEYS:
            await tables.create("T", Row("p", key, {"key": key}))
        for key in KEYS:
            assert await _data(tables, key) == {"key": key}

    async def test_keys_sort_as_their_utf_8_bytes(self, tables: Tables) -> None:
        for key in KEYS:
            await tables.create("T", Row("p", key))
        expected = sorted(KEYS, key=str.encode)
        assert [row.key for row in (await tables.query("T", "p")).rows] == expected
        assert [row.key async for row in _all(tables, limit=3)] == expected

    @pytest.mark.parametrize("text", HOSTILE)
    async def test_what_looks_like_a_query_is_only_a_key(self, tables: Tables, text: str) -> None:
        for key in ("one", "two"):
            await tables.create("T", Row("p", key))
        assert await tables.get("T", "p", text) is None
        assert await tables.get("T", text, "one") is None
        assert (await tables.query("T", text)).rows == ()
        assert (await tables.query("T", "p", first=text, last=text)).rows == ()
        row = await tables.create("T", Row(text, text, {"n": 1}))
        assert (await tables.query("T", text)).rows == (row,)
        with pytest.raises(Conflict):
            await tables.replace("T", Row("p", "one", {}, text))
        assert len((await tables.query("T", "p")).rows) == 2

    @pytest.mark.parametrize("text", ["", "x" * (MAX_KEY_LENGTH + 1), "🤖" * (MAX_KEY_LENGTH + 1), "\ud800", "a\udfff"])
    async def test_a_name_that_cannot_be_is_refused_and_nothing_written(self, tables: Tables, text: str) -> None:
        for row in (Row(text, "k"), Row("p", text)):
            with pytest.raises(ValueError, match="partitions and keys"):
                await tables.create("T", row)
            with pytest.raises(ValueError, match="partitions and keys"):
                await tables.batch("T", [Write("create", row)])
        assert (await tables.query("T", "p")).rows == ()

    # ------------------------------------------------------------ size

    async def test_a_row_holds_256_kb_and_no_more(self, tables: Tables) -> None:
        room = MAX_DATA_BYTES - len('{"text":""}')
        row = await tables.create("T", Row("p", "k", {"text": "x" * room}))
        assert await _data(tables, "k") == {"text": "x" * room}
        big = Row("p", "k", {"text": "x" * (room + 1)}, row.etag)
        with pytest.raises(ValueError, match="262144"):
            await tables.create("T", Row("p", "other", big.data))
        with pytest.raises(ValueError, match="262144"):
            await tables.replace("T", big)
        with pytest.raises(ValueError, match="262144"):
            await tables.batch("T", [Write("create", Row("p", "first")), Write("replace", big)])
        assert [found.key for found in (await tables.query("T", "p")).rows] == ["k"]

    async def test_size_is_counted_in_bytes(self, tables: Tables) -> None:
        with pytest.raises(ValueError, match="262144"):
            await tables.create("T", Row("p", "k", {"text": "🤖" * (MAX_DATA_BYTES // 4)}))

    # ------------------------------------------------------------ query

    async def test_a_query_is_bounded_by_first_and_last(self, tables: Tables) -> None:
        for key in ("a", "aa", "b", "ba", "c", "ä"):
            await tables.create("T", Row("p", key))

        async def keys(**bounds: str | None) -> list[str]:
            return [row.key for row in (await tables.query("T", "p", **bounds)).rows]  # type: ignore[arg-type]

        assert await keys() == ["a", "aa", "b", "ba", "c", "ä"]
        assert await keys(first="b") == ["b", "ba", "c", "ä"]
        assert await keys(last="b") == ["a", "aa"]
        assert await keys(first="aa", last="c") == ["aa", "b", "ba"]
        assert await keys(first="ab", last="ab") == []
        assert await keys(first="c", last="a") == []
        assert await keys(last="") == []
        assert await keys(first="z", last=None) == ["ä"]

    async def test_paging_gives_every_row_once_in_order(self, tables: Tables) -> None:
        keys = [f"k{number:05d}" for number in range(1_050)]
        for start in range(0, len(keys), MAX_BATCH):
            await tables.batch("T", [Write("create", Row("p", key)) for key in keys[start : start + MAX_BATCH]])
        for limit in (7, 100, 1000):
            assert [row.key async for row in _all(tables, limit=limit)] == keys
        whole = await tables.query("T", "p", limit=1000)
        assert (len(whole.rows), whole.cursor is None) == (1000, False)
        assert [row.key async for row in _all(tables, limit=10, first="k00100", last="k00125")] == keys[100:125]
        assert len((await tables.query("T", "p")).rows) == 100

    async def test_a_page_that_ends_with_the_last_row_has_no_cursor(self, tables: Tables) -> None:
        for key in "abcd":
            await tables.create("T", Row("p", key))
        assert (await tables.query("T", "p", limit=4)).cursor is None
        page = await tables.query("T", "p", limit=2)
        page = await tables.query("T", "p", limit=2, cursor=page.cursor)
        assert ([row.key for row in page.rows], page.cursor) == (["c", "d"], None)

    async def test_paging_goes_on_though_rows_come_and_go(self, tables: Tables) -> None:
        rows = {key: await tables.create("T", Row("p", key)) for key in "acegi"}
        page = await tables.query("T", "p", limit=2)
        for key in "ae":
            await tables.delete("T", rows[key])
        for key in "bz":
            await tables.create("T", Row("p", key))
        assert [row.key async for row in _all(tables, limit=2, cursor=page.cursor)] == ["g", "i", "z"]

    async def test_a_cursor_reaches_no_further_than_the_bounds(self, tables: Tables) -> None:
        for key in ("a1", "a2", "b1", "b2"):
            await tables.create("T", Row("p", key))
        early = (await tables.query("T", "p", limit=1)).cursor
        late = (await tables.query("T", "p", limit=3)).cursor
        assert [row.key for row in (await tables.query("T", "p", first="b", cursor=early)).rows] == ["b1", "b2"]
        assert (await tables.query("T", "p", last="b", cursor=late)).rows == ()

    @pytest.mark.parametrize("cursor", ["§", "a b", "=", "_w", "🤖", "'"])
    async def test_what_is_no_cursor_is_refused(self, tables: Tables, cursor: str) -> None:
        with pytest.raises(ValueError, match="cursor"):
            await tables.query("T", "p", cursor=cursor)

    @pytest.mark.parametrize("limit", [0, -1, 1001])
    async def test_a_page_has_1_to_1000_rows(self, tables: Tables, limit: int) -> None:
        with pytest.raises(ValueError, match="limit"):
            await tables.query("T", "p", limit=limit)

    # ------------------------------------------------------------ batch

    async def test_a_batch_does_all_its_writes(self, tables: Tables) -> None:
        old = [await tables.create("T", Row("p", key, {"n": 0})) for key in ("delete", "replace")]
        writes = [
            Write("create", Row("p", "create", {"n": 1})),
            Write("delete", old[0]),
            Write("replace", Row("p", "replace", {"n": 2}, old[1].etag)),
        ]
        created, deleted, replaced = await tables.batch("T", writes)
        assert deleted == old[0]
        assert (await tables.query("T", "p")).rows == (created, replaced)
        assert (created.data, replaced.data) == ({"n": 1}, {"n": 2})

    @pytest.mark.parametrize("place", [0, 3, 6])
    @pytest.mark.parametrize("kind", ["create", "replace", "delete"])
    async def test_one_conflict_in_a_batch_and_nothing_is_written(self, tables: Tables, kind: Any, place: int) -> None:
        kept = [await tables.create("T", Row("p", f"old{number}", {"n": number})) for number in range(3)]
        writes = [
            Write("create", Row("p", "new1")),
            Write("create", Row("p", "new2")),
            Write("create", Row("p", "new3")),
            Write("replace", Row("p", "old0", {"n": 9}, kept[0].etag)),
            Write("delete", kept[1]),
            Write("create", Row("p", "new4")),
        ]
        writes.insert(place, Write(kind, Row("p", "old2", {"n": 9}, "stale")))
        with pytest.raises(Conflict):
            await tables.batch("T", writes)
        assert (await tables.query("T", "p")).rows == tuple(kept)
        await tables.create("T", Row("p", "after"))

    async def test_a_batch_has_up_to_100_writes(self, tables: Tables) -> None:
        writes = [Write("create", Row("p", f"{number:03d}")) for number in range(MAX_BATCH + 1)]
        for wrong in ([], writes):
            with pytest.raises(ValueError, match="1 to 100"):
                await tables.batch("T", wrong)
        assert (await tables.query("T", "p")).rows == ()
        assert len(await tables.batch("T", writes[:MAX_BATCH])) == MAX_BATCH

    async def test_a_batch_holds_1_mb_of_data_and_no_more(self, tables: Tables) -> None:
        room = MAX_BATCH_BYTES // 5 - len('{"text":""}')
        rows = [Row("p", str(number), {"text": "x" * room}) for number in range(5)]
        written = await tables.batch("T", [Write("create", row) for row in rows])
        assert (await tables.query("T", "p")).rows == written
        more = [Write("replace", row) for row in written]
        more[-1] = Write("replace", Row("p", "4", {"text": "x" * room + "y"}, written[-1].etag))
        with pytest.raises(ValueError, match=str(MAX_BATCH_BYTES)):
            await tables.batch("T", more)
        assert (await tables.query("T", "p")).rows == written
        # What is deleted does not count.
        changes = [Write("delete", row) for row in written]
        await tables.batch("T", [*changes, *(Write("create", Row("p", f"new {row.key}", row.data)) for row in rows)])
        assert [row.key for row in (await tables.query("T", "p")).rows] == [f"new {number}" for number in range(5)]

    async def test_a_batch_is_of_one_partition_and_each_key_once(self, tables: Tables) -> None:
        with pytest.raises(ValueError, match="one partition"):
            await tables.batch("T", [Write("create", Row("p", "a")), Write("create", Row("q", "b"))])
        with pytest.raises(ValueError, match="each key once"):
            await tables.batch("T", [Write("create", Row("p", "a")), Write("create", Row("p", "a"))])
        row = await tables.create("T", Row("p", "b"))
        with pytest.raises(ValueError, match="each key once"):
            await tables.batch("T", [Write("delete", row), Write("create", Row("p", "b"))])
        assert [found.key for found in (await tables.query("T", "p")).rows] == ["b"]

    # ------------------------------------------------------------ others

    async def test_another_instance_sees_every_write_at_once(self, tables: Tables, again: Again) -> None:
        other = await again()
        for number in range(50):
            row = await tables.create("T", Row("p", str(number), {"n": number}))
            assert await other.get("T", "p", str(number)) == row
            row = await other.replace("T", row)
            assert await tables.get("T", "p", str(number)) == row
        assert await tables.query("T", "p") == await other.query("T", "p")

    async def test_of_many_writers_with_one_etag_one_wins(self, tables: Tables, again: Again) -> None:
        instances = [tables, await again(), await again()]
        row = await tables.create("T", Row("p", "k", {"n": -1}))
        for _ in range(20):
            results = await asyncio.gather(
                *(
                    each.replace("T", Row("p", "k", {"n": number}, row.etag))
                    for number in range(3)
                    for each in instances
                ),
                return_exceptions=True,
            )
            (won,) = [result for result in results if isinstance(result, Row)]
            assert sum(isinstance(result, Conflict) for result in results) == len(results) - 1
            row = won
            assert await instances[2].get("T", "p", "k") == won

    async def test_it_may_be_closed_twice_and_used_again(self, tables: Tables) -> None:
        await tables.create("T", Row("p", "k"))
        await tables.close()
        await tables.close()
        assert await tables.get("T", "p", "k") is not None


async def _data(tables: Tables, key: str) -> Any:
    row = await tables.get("T", "p", key)
    return None if row is None else row.data


async def _all(tables: Tables, *, limit: int, cursor: str | None = None, **bounds: str) -> Any:
    """Every row of partition ``p``, page by page."""
    while True:
        page = await tables.query("T", "p", limit=limit, cursor=cursor, **bounds)
        assert len(page.rows) <= limit
        for row in page.rows:
            yield row
        cursor = page.cursor
        if cursor is None:
            return
