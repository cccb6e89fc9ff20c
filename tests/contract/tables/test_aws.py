"""``DynamoTables`` keeps the port's promises over moto, and says clearly what is wrong with the real thing."""

import asyncio
import contextlib
import multiprocessing
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest

from function_app.adapters.aws import names
from function_app.adapters.aws import tables as adapter
from function_app.adapters.aws.client import ATTEMPTS
from function_app.adapters.aws.tables import TRIES, DynamoTables
from function_app.ports.tables import Conflict, Page, Row, StoreError, Tables, Write
from tests.contract.tables.suite import Again, TablesSuite
from tests.harness.stores.aws import HOST, REGION, Refusal, Wire, reset, start_moto, start_wire, use_credentials

Open = Callable[..., DynamoTables]
NAME = "telescope"

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with start_moto() as endpoint, pytest.MonkeyPatch.context() as environment:
        use_credentials(environment)
        yield endpoint


@pytest.fixture(scope="module")
def warm(endpoint: str) -> Iterator[DynamoTables]:
    """One for all tests: the SDK takes long to make a client."""
    tables = DynamoTables(table=NAME, region=REGION, endpoint=endpoint)
    yield tables
    asyncio.run(tables.close())


@pytest.fixture
async def tables(warm: DynamoTables, endpoint: str) -> Tables:
    reset(endpoint)
    await warm.prepare()
    return warm


@pytest.fixture
async def opened(endpoint: str) -> AsyncIterator[Open]:
    """Makes more, of other places too."""
    made: list[DynamoTables] = []

    def open_(*, table: str = NAME, at: str = endpoint) -> DynamoTables:
        made.append(DynamoTables(table=table, region=REGION, endpoint=at))
        return made[-1]

    yield open_
    for each in made:
        await each.close()


@pytest.fixture
def again(opened: Open) -> Again:
    async def open_() -> Tables:
        return opened()

    return open_


class TestDynamoTables(TablesSuite):
    pass


@pytest.fixture
def wire(endpoint: str) -> Iterator[Wire]:
    """A way to the emulator that can be spoilt."""
    with start_wire(endpoint) as wire:
        yield wire


@pytest.fixture
async def through(tables: Tables, opened: Open, wire: Wire) -> Tables:
    """A store at the end of ``wire``, which has been used once."""
    through = opened(at=wire.endpoint)
    assert await through.query("T", "p") == await tables.query("T", "p")
    return through


# ---------------------------------------------------------------- long keys

SHARED = "🤖" * (names.HEAD + 100)
LONG = [SHARED + tail for tail in ("", "\x00", "0", "1", "20", "21", "ü", "\U0010ffff")]
LONG += [SHARED[: names.HEAD] + tail for tail in ("\x00", "\x01", "z")]
BETWEEN = [SHARED[: names.HEAD - 1], SHARED[: names.HEAD], SHARED[: names.HEAD - 1] + "🤗", "\U0010ffff", "a"]


async def test_long_keys_with_one_beginning_sort_as_all_others(tables: Tables) -> None:
    keys = sorted({*LONG, *BETWEEN, *(key[::-1] for key in LONG)})
    for key in reversed(keys):
        await tables.create("T", Row("p", key, {"key": key}))
    for limit in (1, 4, 1000):
        assert await keys_of(tables, limit=limit) == keys
    for first in (LONG[-2], LONG[3], LONG[3] + "!", LONG[-1], BETWEEN[0], BETWEEN[1], SHARED[: names.HEAD + 1]):
        assert await keys_of(tables, limit=5, first=first) == [key for key in keys if key >= first]
        assert await keys_of(tables, limit=5, last=first) == [key for key in keys if key < first]
        bounds = {"first": first, "last": LONG[6]}
        assert await keys_of(tables, limit=5, **bounds) == [key for key in keys if first <= key < LONG[6]]


async def test_long_partitions_with_one_beginning_are_apart(tables: Tables) -> None:
    for partition in LONG:
        await tables.create("T", Row(partition, "k", {"partition": partition}))
    for partition in LONG:
        (row,) = (await tables.query("T", partition)).rows
        assert (row.partition, row.data) == (partition, {"partition": partition})


async def keys_of(tables: Tables, *, limit: int, cursor: str | None = None, **bounds: str) -> list[str]:
    page = await tables.query("T", "p", limit=limit, cursor=cursor, **bounds)
    assert len(page.rows) <= limit
    keys = [row.key for row in page.rows]
    return keys if page.cursor is None else keys + await keys_of(tables, limit=limit, cursor=page.cursor, **bounds)


# ---------------------------------------------------------------- cost


async def test_a_page_is_one_request_for_little_more_than_its_rows(tables: Tables, through: Tables, wire: Wire) -> None:
    await tables.batch("T", [Write("create", Row("p", f"{number:03d}")) for number in range(100)])
    wire.spoil()
    page = await through.query("T", "p", first="020", last="090", limit=10)
    assert [row.key for row in page.rows] == [f"{number:03d}" for number in range(20, 30)]
    page = await through.query("T", "p", first="020", last="090", limit=10, cursor=page.cursor)
    assert page.rows[0].key == "030"
    assert wire.operations == ["Query", "Query"]
    assert all(asked.json["Limit"] <= 12 for asked in wire.asked)


async def test_rows_over_many_of_amazons_pages_are_one_page_here(tables: Tables, through: Tables, wire: Wire) -> None:
    text = "x" * 200_000
    for number in range(12):
        await tables.create("T", Row("p", f"{number:02d}", {"text": text}))
    wire.spoil()
    page = await through.query("T", "p", limit=11)
    assert [row.key for row in page.rows] == [f"{number:02d}" for number in range(11)]
    assert page.cursor is not None
    assert wire.operations.count("Query") == len(wire.operations) > 2


async def test_what_is_read_is_what_was_written_last(through: Tables, wire: Wire) -> None:
    wire.spoil()
    await through.get("T", "p", "k")
    await through.query("T", "p")
    assert [asked.json["ConsistentRead"] for asked in wire.asked] == [True, True]


# ---------------------------------------------------------------- lost requests and answers


async def test_a_write_whose_answer_was_lost_is_no_conflict(tables: Tables, through: Tables, wire: Wire) -> None:
    wire.spoil("lose answer")
    row = await through.create("T", Row("p", "k", {"n": 1}))
    assert await tables.get("T", "p", "k") == row
    wire.spoil("lose answer")
    row = await through.replace("T", Row("p", "k", {"n": 2}, row.etag))
    assert await tables.get("T", "p", "k") == row
    assert wire.operations == ["PutItem", "PutItem", "GetItem"]


async def test_a_lost_write_after_another_write_is_a_conflict(tables: Tables, through: Tables, wire: Wire) -> None:
    row = await tables.create("T", Row("p", "k", {"n": 1}))
    wire.spoil("lose request")
    with pytest.raises(Conflict):
        await through.create("T", Row("p", "k", {"n": 1}))
    await tables.replace("T", row)
    wire.spoil("lose request")
    with pytest.raises(Conflict):
        await through.replace("T", row)
    assert wire.operations == ["PutItem", "PutItem", "GetItem"]


async def test_a_transaction_is_sent_again_under_the_same_token(tables: Tables, through: Tables, wire: Wire) -> None:
    wire.spoil("lose request")
    (row,) = await through.batch("T", [Write("create", Row("p", "k"))])
    first = {asked.json["ClientRequestToken"] for asked in wire.asked}
    wire.spoil("lose request")
    await through.delete("T", row)
    second = {asked.json["ClientRequestToken"] for asked in wire.asked}
    assert wire.operations == ["TransactWriteItems"] * 2
    assert (len(first), len(second), first & second) == (1, 1, set())
    assert await tables.get("T", "p", "k") is None


IN_THE_WAY = Refusal(
    400, "TransactionCanceledException", {"CancellationReasons": [{"Code": "None"}, {"Code": "TransactionConflict"}]}
)
UNFIT = Refusal(
    400,
    "TransactionCanceledException",
    {"CancellationReasons": [{"Code": "TransactionConflict"}, {"Code": "ConditionalCheckFailed"}]},
)


async def test_another_transaction_in_the_way_is_waited_for(through: Tables, wire: Wire) -> None:
    wire.spoil(IN_THE_WAY, IN_THE_WAY)
    rows = await through.batch("T", [Write("create", Row("p", "a")), Write("create", Row("p", "b"))])
    assert len(wire.asked) == 3
    wire.spoil(Refusal(400, "TransactionConflictException", {}))
    await through.replace("T", rows[0])
    assert wire.operations == ["PutItem", "PutItem"]


async def test_another_transaction_that_stays_in_the_way_is_said_to(
    through: Tables, wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_PAUSE_S", 0.001)
    wire.spoil(*[IN_THE_WAY] * TRIES)
    with pytest.raises(StoreError, match=r"too much to do.*Try again"):
        await through.batch("T", [Write("create", Row("p", "a")), Write("create", Row("p", "b"))])
    assert (await through.query("T", "p")).rows == ()


async def test_a_conflict_is_not_tried_again_and_names_the_row(through: Tables, wire: Wire) -> None:
    wire.spoil(UNFIT)
    with pytest.raises(Conflict, match="'b'"):
        await through.batch("T", [Write("create", Row("p", "a")), Write("create", Row("p", "b"))])
    assert len(wire.asked) == 1


# ---------------------------------------------------------------- what can be wrong


@pytest.mark.usefixtures("tables")
async def test_a_table_that_is_not_there_is_named(opened: Open) -> None:
    absent = opened(table="absent")
    for call in calls(absent):
        with pytest.raises(
            StoreError, match=f"'absent' in {REGION}.* does not exist.*TELESCOPE_AWS_TABLE.*sort key 'k'"
        ):
            await call()


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("AccessDeniedException", "may not be used.*Check the credentials"),
        ("UnrecognizedClientException", "may not be used.*Check the credentials"),
        ("ValidationException", "cannot be used: .*ValidationException"),
    ],
)
async def test_a_refusal_is_said_in_one_line(through: Tables, wire: Wire, code: str, says: str) -> None:
    for call in calls(through):
        wire.spoil(Refusal(400, code, {}))
        with pytest.raises(StoreError, match=f"table '{NAME}'.*{says}") as caught:
            await call()
        assert "\n" not in str(caught.value)
        assert len(wire.asked) == 1


async def test_too_much_to_do_is_tried_a_few_times(through: Tables, wire: Wire) -> None:
    wire.spoil(*[Refusal(400, "ThrottlingException", {})] * ATTEMPTS)
    with pytest.raises(StoreError, match=r"too much to do.*Try again"):
        await through.get("T", "p", "k")
    assert len(wire.asked) == ATTEMPTS


async def test_an_unreachable_address_is_named(opened: Open) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        address = f"http://{HOST}:{taken.getsockname()[1]}"
        unreachable = opened(at=address)
        with pytest.raises(StoreError, match=f"at {address} cannot be reached.*Check TELESCOPE_AWS_ENDPOINT and"):
            await unreachable.create("T", Row("p", "k"))


async def test_missing_credentials_are_said_to_be(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    with pytest.raises(StoreError, match=r"Unable to locate credentials\. Give this program a role, or set AWS_ACCESS"):
        await opened().get("T", "p", "k")


async def test_what_is_no_text_is_refused(tables: Tables) -> None:
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


async def test_preparing_is_safe_to_repeat_and_keeps_rows(tables: Tables, opened: Open) -> None:
    row = await tables.create("T", Row("p", "k"))
    await asyncio.gather(*(opened().prepare() for _ in range(4)))
    assert await tables.get("T", "p", "k") == row


def calls(tables: Tables) -> tuple[Callable[[], Awaitable[object]], ...]:
    row = Row("p", "k", {}, "etag")
    return (
        lambda: tables.get("T", "p", "k"),
        lambda: tables.create("T", row),
        lambda: tables.replace("T", row),
        lambda: tables.delete("T", row),
        lambda: tables.query("T", "p"),
        lambda: tables.batch("T", [Write("create", row), Write("create", Row("p", "other"))]),
    )


# ---------------------------------------------------------------- several processes

PROCESSES = 4
ROUNDS = 12


async def test_of_many_processes_one_wins_each_row_and_no_change_is_lost(tables: Tables, endpoint: str) -> None:
    await tables.create("T", Row("p", "count", {"n": 0}))
    with ProcessPoolExecutor(PROCESSES, mp_context=multiprocessing.get_context("spawn")) as pool:
        won = [place for each in pool.map(_race, [endpoint] * PROCESSES) for place in each]
    assert sorted(won) == sorted(f"{kind}{number}" for kind in ("row", "batch") for number in range(ROUNDS))
    count = await tables.get("T", "p", "count")
    assert count is not None
    assert count.data == {"n": PROCESSES * ROUNDS}


def _race(endpoint: str) -> list[str]:
    return asyncio.run(_races(endpoint))


async def _races(endpoint: str) -> list[str]:
    tables = DynamoTables(table=NAME, region=REGION, endpoint=endpoint)
    won = []
    for number in range(ROUNDS):
        with contextlib.suppress(Conflict):
            await tables.create("T", Row("p", f"row{number}"))
            won.append(f"row{number}")
        with contextlib.suppress(Conflict):
            writes = [Write("create", Row("q", f"{each}{number}")) for each in ("batch", "beside")]
            won.append((await tables.batch("T", writes))[0].key)
        await _count(tables)
    await tables.close()
    return won


async def _count(tables: Tables) -> None:
    """Add one, as often as it takes."""
    for _ in range(10_000):
        row = await tables.get("T", "p", "count")
        assert row is not None
        with contextlib.suppress(Conflict):
            await tables.replace("T", Row("p", "count", {"n": row.data["n"] + 1}, row.etag))
            return
    raise AssertionError("never came to write")
