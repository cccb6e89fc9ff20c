"""``DynamoTables`` fulfils the contract of its port on moto."""

import asyncio
from collections.abc import Callable, Iterator

import pytest

from function_app.adapters.aws import names
from function_app.adapters.aws import tables as adapter
from function_app.adapters.aws.tables import TRIES, DynamoTables
from function_app.ports.tables import Conflict, Page, Row, StoreError, Tables
from tests.contract.conftest import Closing
from tests.contract.tables.suite import Again, TablesSuite, all_rows, create_rows
from tests.harness.stores.aws import REGION, FaultProxy, Refusal, reset, start_fault_proxy

Open = Callable[[str], DynamoTables]
NAME = "telescope"

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def warm(moto: str) -> Iterator[DynamoTables]:
    """Shared by all tests: creating a client of the SDK is slow."""
    tables = DynamoTables(table=NAME, region=REGION, endpoint=moto)
    yield tables
    asyncio.run(tables.close())


@pytest.fixture
async def tables(warm: DynamoTables, moto: str) -> Tables:
    reset(moto)
    await warm.prepare()
    return warm


@pytest.fixture
def open_at(closing: Closing) -> Open:
    """Opens the table at an address."""
    return lambda address: closing(DynamoTables(table=NAME, region=REGION, endpoint=address))


@pytest.fixture
def again(open_at: Open, moto: str) -> Again:
    return lambda: open_at(moto)


class TestDynamoTables(TablesSuite):
    pass


@pytest.fixture
def proxy(moto: str) -> Iterator[FaultProxy]:
    with start_fault_proxy(moto) as proxy:
        yield proxy


@pytest.fixture
async def over_wire(tables: Tables, open_at: Open, proxy: FaultProxy) -> Tables:
    """The same table over a proxy with faults, after its first call."""
    over_wire = open_at(proxy.endpoint)
    assert await over_wire.query("T", "p") == await tables.query("T", "p")
    proxy.inject()
    return over_wire


# ---------------------------------------------------------------- keys

START = "🤖" * (names.HEAD + 100)
LONG = [START + end for end in ("", "\x00", "0", "1", "20", "21", "ü", "\U0010ffff")]
LONG += [START[: names.HEAD] + end for end in ("\x00", "\x01", "z")]
BETWEEN = [START[: names.HEAD - 1], START[: names.HEAD], START[: names.HEAD - 1] + "🤗", "\U0010ffff", "a"]


async def test_long_keys_with_the_same_start_are_paged_in_order(tables: Tables) -> None:
    keys = sorted({*LONG, *BETWEEN, *(key[::-1] for key in LONG)})
    await create_rows(tables, *reversed(keys))
    for limit in (1, 4, 1000):
        assert [row.key async for row in all_rows(tables, limit=limit)] == keys
    for first in (LONG[-2], LONG[3], LONG[3] + "!", LONG[-1], BETWEEN[0], BETWEEN[1], START[: names.HEAD + 1]):
        for lower, upper in ((first, None), ("", first), (first, LONG[6])):
            expected = [key for key in keys if lower <= key and (upper is None or key < upper)]
            assert [row.key async for row in all_rows(tables, limit=5, first=lower, last=upper)] == expected


async def test_long_partitions_with_the_same_start_are_separate(tables: Tables) -> None:
    rows = [await tables.create("T", Row(partition, "k", {"partition": partition})) for partition in LONG]
    assert [(await tables.query("T", partition)).rows for partition in LONG] == [(row,) for row in rows]


async def test_reading_with_an_invalid_key_is_rejected(tables: Tables) -> None:
    for call in (
        tables.get("T", "\ud800", "k"),
        tables.get("T", "p", "\ud800"),
        tables.query("T", "\ud800"),
        tables.query("T", "p", first="\ud800"),
        tables.query("T", "p", last="\ud800"),
    ):
        with pytest.raises(ValueError, match="partitions and keys"):
            await call
    assert await tables.get("T", "", "") is None
    assert await tables.query("T", "") == Page((), None)


# ---------------------------------------------------------------- requests


async def test_a_page_is_one_request_with_few_extra_rows(tables: Tables, over_wire: Tables, proxy: FaultProxy) -> None:
    keys = [f"{number:03d}" for number in range(100)]
    await create_rows(tables, *keys)
    page = await over_wire.query("T", "p", first="020", last="090", limit=10)
    assert [row.key for row in page.rows] == keys[20:30]
    page = await over_wire.query("T", "p", first="020", last="090", limit=10, cursor=page.cursor)
    assert page.rows[0].key == "030"
    await over_wire.get("T", "p", "k")
    assert proxy.operations == ["Query", "Query", "GetItem"]
    assert all(request.json["Limit"] <= 12 for request in proxy.requests[:2])
    assert [request.json["ConsistentRead"] for request in proxy.requests] == [True] * 3


async def test_a_page_may_need_several_requests(tables: Tables, over_wire: Tables, proxy: FaultProxy) -> None:
    keys = [f"{number:02d}" for number in range(12)]
    for key in keys:
        await tables.create("T", Row("p", key, {"text": "x" * 200_000}))
    page = await over_wire.query("T", "p", limit=11)
    assert [row.key for row in page.rows] == keys[:11]
    assert page.cursor is not None
    assert proxy.operations.count("Query") == len(proxy.operations) > 2


# ---------------------------------------------------------------- lost requests and responses


async def test_a_write_with_a_lost_response_is_not_a_conflict(
    tables: Tables, over_wire: Tables, proxy: FaultProxy
) -> None:
    proxy.inject("lose response")
    row = await over_wire.create("T", Row("p", "k", {"n": 1}))
    assert await tables.get("T", "p", "k") == row
    proxy.inject("lose response")
    row = await over_wire.replace("T", Row("p", "k", {"n": 2}, row.etag))
    assert await tables.get("T", "p", "k") == row
    assert proxy.operations == ["PutItem", "PutItem", "GetItem"]


async def test_a_lost_write_after_another_write_is_a_conflict(
    tables: Tables, over_wire: Tables, proxy: FaultProxy
) -> None:
    row = await tables.create("T", Row("p", "k", {"n": 1}))
    proxy.inject("lose request")
    with pytest.raises(Conflict):
        await over_wire.create("T", Row("p", "k", {"n": 1}))
    await tables.replace("T", row)
    proxy.inject("lose request")
    with pytest.raises(Conflict):
        await over_wire.replace("T", row)
    assert proxy.operations == ["PutItem", "PutItem", "GetItem"]


async def test_a_transaction_is_retried_with_the_same_token(
    tables: Tables, over_wire: Tables, proxy: FaultProxy
) -> None:
    proxy.inject("lose request")
    (row,) = await create_rows(over_wire, "k")
    first = {request.json["ClientRequestToken"] for request in proxy.requests}
    proxy.inject("lose request")
    await over_wire.delete("T", row)
    second = {request.json["ClientRequestToken"] for request in proxy.requests}
    assert proxy.operations == ["TransactWriteItems"] * 2
    assert (len(first), len(second), first & second) == (1, 1, set())
    assert await tables.get("T", "p", "k") is None


def cancelled(*reasons: str) -> Refusal:
    more = {"CancellationReasons": [{"Code": reason} for reason in reasons]}
    return Refusal(400, "TransactionCanceledException", more)


async def test_a_write_waits_for_another_transaction(over_wire: Tables, proxy: FaultProxy) -> None:
    proxy.inject(*[cancelled("None", "TransactionConflict")] * 2)
    rows = await create_rows(over_wire, "a", "b")
    assert len(proxy.requests) == 3
    proxy.inject(Refusal(400, "TransactionConflictException", {}))
    await over_wire.replace("T", rows[0])
    assert proxy.operations == ["PutItem", "PutItem"]


async def test_a_write_that_always_conflicts_with_transactions_is_an_error(
    over_wire: Tables, proxy: FaultProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_PAUSE_S", 0.001)
    proxy.inject(*[cancelled("None", "TransactionConflict")] * TRIES)
    with pytest.raises(StoreError, match=r"is overloaded.*Try again"):
        await create_rows(over_wire, "a", "b")
    assert (await over_wire.query("T", "p")).rows == ()


async def test_a_conflict_is_not_retried_and_names_the_row(over_wire: Tables, proxy: FaultProxy) -> None:
    proxy.inject(cancelled("TransactionConflict", "ConditionalCheckFailed"))
    with pytest.raises(Conflict, match="'b'"):
        await create_rows(over_wire, "a", "b")
    assert len(proxy.requests) == 1


async def test_prepare_is_idempotent_and_preserves_rows(tables: Tables, open_at: Open, moto: str) -> None:
    row = await tables.create("T", Row("p", "k"))
    await asyncio.gather(*(open_at(moto).prepare() for _ in range(4)))
    assert await tables.get("T", "p", "k") == row
