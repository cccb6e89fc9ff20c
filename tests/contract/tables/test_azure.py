"""``AzureTables`` fulfils the contract of its port on Azurite."""

import secrets
from collections.abc import Iterator

import msgspec
import pytest

from function_app.adapters.azure.client import Endpoint
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
from tests.contract.conftest import Closing
from tests.contract.tables.suite import Again, TablesSuite, all_rows, create_rows
from tests.harness.stores.aws import Fault, FaultProxy, Refusal, start_fault_proxy
from tests.harness.stores.azure import endpoint, through

pytestmark = pytest.mark.anyio


@pytest.fixture
def prefix() -> str:
    """Separate tables per test."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
def again(azurite: str, prefix: str, closing: Closing) -> Again:
    return lambda: closing(AzureTables(endpoint=Endpoint(azurite), prefix=prefix))


@pytest.fixture
def tables(again: Again) -> Tables:
    return again()


class TestAzureTables(TablesSuite):
    pass


@pytest.fixture
def proxy(azurite: str) -> Iterator[FaultProxy]:
    with start_fault_proxy(endpoint(azurite, "Table")) as proxy:
        yield proxy


@pytest.fixture
async def over_wire(azurite: str, proxy: FaultProxy, prefix: str, closing: Closing) -> Tables:
    """The same store over a proxy with faults; its table exists."""
    tables = closing(AzureTables(endpoint=Endpoint(through(azurite, proxy.endpoint, "Table")), prefix=prefix))
    await tables.create("T", Row("p", "first"))
    return tables


# ---------------------------------------------------------------- keys and data


async def test_long_keys_with_the_same_start_are_paged_in_order(tables: Tables) -> None:
    starts = ("n" * 469, "n" * 468 + "m")
    ends = ("", "z", "a", "ü", "🤖", "b/c", *(f"{number:02d}" for number in range(8)))
    keys = [start + end for start in starts for end in ends]
    keys += ["n", "n" * 400, "o", "🤖" * 512, "🤖" * 511 + "🦾", "🤖" * 511 + "🤕"]
    await tables.batch("T", [Write("create", Row("p", key, {"key": key})) for key in keys])
    keys.sort(key=str.encode)
    for limit in (1, 1000):
        assert [row.key async for row in all_rows(tables, limit=limit)] == keys
    for first, last in ((keys[5], keys[20]), (keys[3], None), ("", keys[9]), (starts[0] + "0", starts[0] + "2")):
        expected = [key for key in keys if first <= key and (last is None or key < last)]
        assert [row.key async for row in all_rows(tables, limit=5, first=first, last=last)] == expected
    for key in keys[::4]:
        row = await tables.get("T", "p", key)
        assert row is not None
        assert row.data == {"key": key}


async def test_the_largest_page_needs_two_requests(tables: Tables) -> None:
    keys = [f"k{number:05d}" for number in range(1_050)]
    for start in range(0, len(keys), MAX_BATCH):
        await create_rows(tables, *keys[start : start + MAX_BATCH])
    page = await tables.query("T", "p", limit=1000)
    assert [row.key for row in page.rows] == keys[:1000]
    assert [row.key async for row in all_rows(tables, limit=1000, cursor=page.cursor)] == keys[1000:]


async def test_long_partitions_with_the_same_start_are_separate(tables: Tables) -> None:
    partitions = ["n" * 469, "n" * 469 + "a", "n" * 469 + "b", "🤖" * 512, "🤖" * 511 + "🦾"]
    rows = [await tables.create("T", Row(partition, "k", {"p": partition})) for partition in partitions]
    assert [(await tables.query("T", partition)).rows for partition in partitions] == [(row,) for row in rows]


async def test_any_data_fills_a_row_and_smaller_data_replaces_all_of_it(tables: Tables) -> None:
    row = await tables.create("T", Row("p", "k"))
    for letter in ("x", "ü", "🤖", "\\", '"', "\x00", "\u2028", "\uffff"):
        for start in ("", "a"):  # even and odd positions
            length = len(msgspec.json.encode(letter)) - 2
            text = start + letter * ((MAX_DATA_BYTES - len('{"text":""}') - len(start)) // length)
            row = await tables.replace("T", Row("p", "k", {"text": text}, row.etag))
            assert await tables.get("T", "p", "k") == row
            assert (await tables.query("T", "p")).rows == (row,)
    row = await tables.replace("T", Row("p", "k", {"n": 1}, row.etag))
    assert await tables.get("T", "p", "k") == row
    (row,) = await tables.batch("T", [Write("replace", Row("p", "k", {"n": 2}, row.etag))])
    assert (await tables.query("T", "p")).rows == (row,)


async def test_the_largest_batch_is_written_and_a_larger_one_is_rejected(tables: Tables) -> None:
    key = "🤖" * (MAX_KEY_LENGTH - 1)
    text = "ü" * ((MAX_BATCH_BYTES // MAX_BATCH - len('{"text":""}')) // 2)  # the SDK escapes it with six bytes
    writes = [Write("create", Row(key + "p", key + chr(33 + n), {"text": text})) for n in range(MAX_BATCH)]
    written = await tables.batch("T", writes)
    assert (await tables.query("T", key + "p")).rows == written
    larger = [Write("replace", Row(row.partition, row.key, {"text": text + "x" * 99}, row.etag)) for row in written]
    with pytest.raises(ValueError, match=f"at most {MAX_BATCH_BYTES} bytes"):
        await tables.batch("T", larger)
    assert (await tables.query("T", key + "p")).rows == written


# ---------------------------------------------------------------- lost requests and responses


@pytest.mark.parametrize("fault", ["lose response", "lose request", Refusal(500, "InternalError", {})], ids=str)
async def test_a_write_is_applied_once_despite_connection_errors(
    over_wire: Tables, tables: Tables, proxy: FaultProxy, fault: Fault
) -> None:
    proxy.inject(fault)
    row = await over_wire.create("T", Row("p", "k", {"n": 1}))
    assert await tables.get("T", "p", "k") == row
    proxy.inject(fault)
    row = await over_wire.replace("T", Row("p", "k", {"n": 2}, row.etag))
    assert await tables.get("T", "p", "k") == row
    deleted = await tables.create("T", Row("p", "deleted"))
    replacement = Row("p", "k", {"n": 3}, row.etag)
    proxy.inject(fault)
    created, row, _ = await over_wire.batch(
        "T", [Write("create", Row("p", "new")), Write("replace", replacement), Write("delete", deleted)]
    )
    assert await tables.get("T", "p", "k") == row
    assert await tables.get("T", "p", "new") == created
    assert await tables.get("T", "p", "deleted") is None
    assert not proxy.faults
    proxy.inject(fault)
    assert await over_wire.get("T", "p", "k") == row
    proxy.inject(fault)
    assert len((await over_wire.query("T", "p")).rows) == 3


async def test_the_row_of_another_writer_is_never_mistaken_for_the_own_one(
    over_wire: Tables, tables: Tables, proxy: FaultProxy
) -> None:
    row = await tables.create("T", Row("p", "k", {"n": 1}))
    proxy.inject("lose request")
    with pytest.raises(Conflict):
        await over_wire.create("T", Row("p", "k", {"n": 1}))
    await tables.replace("T", row)
    proxy.inject("lose request")
    with pytest.raises(Conflict):
        await over_wire.replace("T", row)
    proxy.inject("lose request")
    with pytest.raises(Conflict):
        await over_wire.batch("T", [Write("create", Row("p", "l")), Write("replace", row)])
    assert await tables.get("T", "p", "l") is None


async def test_a_delete_without_response_is_an_error(over_wire: Tables, tables: Tables, proxy: FaultProxy) -> None:
    row = await tables.create("T", Row("p", "k"))
    proxy.inject("lose response")
    with pytest.raises(StoreError, match="cannot be reached"):
        await over_wire.delete("T", row)


async def test_a_missing_permission_to_create_a_table_is_reported(
    azurite: str, proxy: FaultProxy, prefix: str, closing: Closing
) -> None:
    tables = closing(AzureTables(endpoint=Endpoint(through(azurite, proxy.endpoint, "Table")), prefix=prefix))
    proxy.inject("pass", Refusal(403, "AuthorizationPermissionMismatch", {}))
    with pytest.raises(StoreError, match=f"'{prefix}…' denied access"):
        await tables.create("T", Row("p", "k"))
