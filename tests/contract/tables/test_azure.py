"""``AzureTables`` keeps the port's promises over Azurite, and says clearly what is wrong with the real thing."""

import asyncio
import multiprocessing
import secrets
from collections.abc import AsyncIterator, Iterator
from typing import Any

import msgspec
import pytest

from function_app.adapters.azure.client import ATTEMPTS, Place
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import (
    MAX_BATCH,
    MAX_BATCH_BYTES,
    MAX_DATA_BYTES,
    MAX_KEY_LENGTH,
    Conflict,
    Row,
    StoreError,
    Tables,
    Write,
)
from tests.contract.tables.suite import Again, TablesSuite
from tests.harness.stores.aws import Fault, Refusal, Wire, start_wire
from tests.harness.stores.azure import KEY, endpoint, run_count_up, start_azurite, through

ROUNDS = 25
_SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def connection() -> Iterator[str]:
    with start_azurite() as connection:
        yield connection


@pytest.fixture
def prefix() -> str:
    """Tables of each test's own."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
async def tables(connection: str, prefix: str) -> AsyncIterator[Tables]:
    tables = AzureTables(place=Place(connection), prefix=prefix)
    yield tables
    await tables.close()


@pytest.fixture
async def again(connection: str, prefix: str) -> AsyncIterator[Again]:
    opened: list[AzureTables] = []

    async def open_() -> Tables:
        opened.append(AzureTables(place=Place(connection), prefix=prefix))
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


class TestAzureTables(TablesSuite):
    pass


pytestmark = pytest.mark.anyio


@pytest.fixture
def wire(connection: str) -> Iterator[Wire]:
    with start_wire(endpoint(connection, "Table")) as wire:
        yield wire


@pytest.fixture
async def spoilt(connection: str, wire: Wire, prefix: str) -> AsyncIterator[Tables]:
    """The same store over a wire that can be spoilt; its table is there."""
    tables = AzureTables(place=Place(through(connection, wire.endpoint, "Table")), prefix=prefix)
    await tables.create("T", Row("p", "first"))
    yield tables
    await tables.close()


# ---------------------------------------------------------------- keys and data


async def test_long_keys_with_one_head_are_paged_in_order(tables: Tables) -> None:
    heads = ("n" * 469, "n" * 468 + "m")
    keys = [head + tail for head in heads for tail in ("", "z", "a", "ü", "🤖", "b/c", *(f"{n:02d}" for n in range(8)))]
    keys += ["n", "n" * 400, "o", "🤖" * 512, "🤖" * 511 + "🦾", "🤖" * 511 + "🤕"]
    for start in range(0, len(keys), 50):
        await tables.batch("T", [Write("create", Row("p", key, {"key": key})) for key in keys[start : start + 50]])
    keys.sort(key=str.encode)
    for limit in (1, 7, 1000):
        assert await _keys(tables, limit=limit) == keys
    for first, last in ((keys[5], keys[20]), (keys[3], None), ("", keys[9]), (heads[0] + "0", heads[0] + "2")):
        expected = [key for key in keys if first <= key and (last is None or key < last)]
        assert await _keys(tables, limit=5, first=first, last=last) == expected
    for key in keys:
        found = await tables.get("T", "p", key)
        assert found is not None
        assert found.data == {"key": key}


async def test_long_partitions_with_one_head_are_apart(tables: Tables) -> None:
    partitions = ["n" * 469, "n" * 469 + "a", "n" * 469 + "b", "🤖" * 512, "🤖" * 511 + "🦾"]
    for partition in partitions:
        await tables.create("T", Row(partition, "k", {"p": partition}))
    for partition in partitions:
        assert [row.data for row in (await tables.query("T", partition)).rows] == [{"p": partition}]


@pytest.mark.parametrize("letter", ["x", "ü", "🤖", "\\", '"', "\x00", "\u2028", "\uffff"], ids=ascii)
@pytest.mark.parametrize("before", ["", "a"], ids=["even", "odd"])
async def test_data_of_every_kind_fills_a_row(tables: Tables, letter: str, before: str) -> None:
    one = len(msgspec.json.encode(letter)) - 2
    text = before + letter * ((MAX_DATA_BYTES - len('{"text":""}') - len(before)) // one)
    row = await tables.create("T", Row("p", "k", {"text": text}))
    assert await tables.get("T", "p", "k") == row
    assert (await tables.query("T", "p")).rows == (row,)


async def test_data_that_becomes_less_leaves_nothing_behind(tables: Tables) -> None:
    row = await tables.create("T", Row("p", "k", {"text": "x" * 200_000}))
    row = await tables.replace("T", Row("p", "k", {"n": 1}, row.etag))
    assert await tables.get("T", "p", "k") == row
    await tables.batch("T", [Write("replace", Row("p", "k", {"n": 2}, row.etag))])
    assert (await tables.query("T", "p")).rows[0].data == {"n": 2}


@pytest.mark.parametrize("letter", ["ü", '"', "🤖"])
async def test_the_largest_batch_passes_and_a_larger_one_is_refused_before_it_is_sent(
    tables: Tables, letter: str
) -> None:
    key = "🤖" * (MAX_KEY_LENGTH - 1)
    bytes_ = MAX_BATCH_BYTES // MAX_BATCH
    text = letter * ((bytes_ - len('{"text":""}')) // (len(msgspec.json.encode(letter)) - 2))
    writes = [Write("create", Row(key + "p", key + chr(33 + n), {"text": text})) for n in range(MAX_BATCH)]
    written = await tables.batch("T", writes)
    assert (await tables.query("T", key + "p")).rows == written
    more = [Write("replace", Row(row.partition, row.key, {"text": text + "x" * 99}, row.etag)) for row in written]
    with pytest.raises(ValueError, match=f"at most {MAX_BATCH_BYTES} bytes"):
        await tables.batch("T", more)
    assert (await tables.query("T", key + "p")).rows == written


# ---------------------------------------------------------------- answers that get lost


@pytest.mark.parametrize("fault", ["lose answer", "lose request", Refusal(500, "InternalError", {})], ids=str)
async def test_a_write_is_done_once_though_the_wire_fails(
    spoilt: Tables, tables: Tables, wire: Wire, fault: Fault
) -> None:
    wire.spoil(fault)
    row = await spoilt.create("T", Row("p", "k", {"n": 1}))
    assert await tables.get("T", "p", "k") == row
    wire.spoil(fault)
    row = await spoilt.replace("T", Row("p", "k", {"n": 2}, row.etag))
    assert await tables.get("T", "p", "k") == row
    wire.spoil(fault)
    gone = await tables.create("T", Row("p", "gone"))
    new, row, _ = await spoilt.batch(
        "T",
        [Write("create", Row("p", "new")), Write("replace", Row("p", "k", {"n": 3}, row.etag)), Write("delete", gone)],
    )
    assert await tables.get("T", "p", "k") == row
    assert await tables.get("T", "p", "new") == new
    assert await tables.get("T", "p", "gone") is None
    assert not wire.faults
    wire.spoil(fault)
    assert await spoilt.get("T", "p", "k") == row
    wire.spoil(fault)
    assert len((await spoilt.query("T", "p")).rows) == 3


async def test_another_writer_s_row_is_never_taken_for_ones_own(spoilt: Tables, tables: Tables, wire: Wire) -> None:
    wire.spoil("lose request")
    await tables.create("T", Row("p", "k", {"n": 1}))
    with pytest.raises(Conflict):
        await spoilt.create("T", Row("p", "k", {"n": 1}))
    row = await tables.get("T", "p", "k")
    assert row is not None
    await tables.replace("T", row)
    wire.spoil("lose request")
    with pytest.raises(Conflict):
        await spoilt.replace("T", row)
    wire.spoil("lose request")
    with pytest.raises(Conflict):
        await spoilt.batch("T", [Write("create", Row("p", "l")), Write("replace", row)])
    assert await tables.get("T", "p", "l") is None


async def test_a_delete_whose_answer_was_lost_says_that_it_is_not_known(
    spoilt: Tables, tables: Tables, wire: Wire
) -> None:
    row = await tables.create("T", Row("p", "k"))
    wire.spoil("lose answer")
    with pytest.raises(StoreError, match="cannot be reached"):
        await spoilt.delete("T", row)


# ---------------------------------------------------------------- what can be wrong


async def test_nothing_is_opened_before_the_first_call() -> None:
    tables = AzureTables(place=Place("nonsense"), prefix="test")
    await tables.close()


@pytest.mark.parametrize(
    ("connection", "says"),
    [
        ("nonsense", "TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=", "TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=bm8=;TableEndpoint=http://127.0.0.1:1/a", "cannot be reached"),
        ("AccountName=a;AccountKey=no;TableEndpoint=http://127.0.0.1:1/a", "TELESCOPE_STORAGE_CONNECTION"),
    ],
)
async def test_a_wrong_connection_is_said_in_one_line(connection: str, says: str) -> None:
    tables = AzureTables(place=Place(connection), prefix="test")
    for _ in range(2):
        text = await _complaint(tables)
        assert says in text
        assert "AccountKey=" not in text
    await tables.close()


async def test_a_wrong_key_is_said_to_be(connection: str) -> None:
    wrong = connection.replace(KEY, "d3Jvbmc=")
    tables = AzureTables(place=Place(wrong), prefix="test")
    text = await _complaint(tables)
    assert "may not be used" in text
    assert "Check TELESCOPE_STORAGE_CONNECTION" in text
    assert "d3Jvbmc=" not in text
    await tables.close()


@pytest.mark.parametrize(("status", "says"), [(503, "too much to do"), (500, "cannot be used")])
async def test_a_store_that_goes_on_failing_is_said_to(spoilt: Tables, wire: Wire, status: int, says: str) -> None:
    wire.spoil(*[Refusal(status, "ServerBusy", {})] * ATTEMPTS)
    assert says in await _complaint(spoilt)
    assert len(wire.asked) == ATTEMPTS
    assert await spoilt.get("T", "p", "first") is not None


async def test_an_answer_of_something_else_is_said_to_be(spoilt: Tables, wire: Wire) -> None:
    wire.spoil(*[Refusal(502, "BadGateway", {}, "application/x-nonsense")] * ATTEMPTS)
    assert "not Azure's" in await _complaint(spoilt)


async def test_a_table_that_may_not_be_made_is_said_to_be_missing_rights(
    connection: str, wire: Wire, prefix: str
) -> None:
    tables = AzureTables(place=Place(through(connection, wire.endpoint, "Table")), prefix=prefix)
    wire.spoil("pass", Refusal(403, "AuthorizationPermissionMismatch", {}))
    with pytest.raises(StoreError, match=f"'{prefix}…' may not be used"):
        await tables.create("T", Row("p", "k"))
    await tables.close()


# ---------------------------------------------------------------- processes


async def test_of_processes_that_write_one_row_each_write_counts_once(
    tables: Tables, connection: str, prefix: str
) -> None:
    with _SPAWN.Pool(3) as pool:
        lost = await asyncio.to_thread(pool.starmap, run_count_up, [(connection, prefix, ROUNDS)] * 3, 1)
    assert sum(lost) > 0, "they never met"
    row = await tables.get("T", "p", "k")
    assert row is not None
    assert row.data == {"n": 3 * ROUNDS}


async def _keys(tables: Tables, *, limit: int, **bounds: Any) -> list[str]:
    found: list[str] = []
    cursor: str | None = None
    while True:
        page = await tables.query("T", "p", limit=limit, cursor=cursor, **bounds)
        assert len(page.rows) <= limit
        found += (row.key for row in page.rows)
        cursor = page.cursor
        if cursor is None:
            return found


async def _complaint(tables: Tables) -> str:
    with pytest.raises(StoreError) as caught:
        await tables.create("T", Row("p", "k"))
    assert "\n" not in str(caught.value)
    return str(caught.value)
