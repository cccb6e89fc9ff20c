"""``AzureBlobs`` keeps the port's promises over Azurite, and says clearly what is wrong with the real thing."""

import asyncio
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from typing import Any

import httpx
import pytest

from function_app.adapters.azure import blobs as adapter
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import ATTEMPTS, Place
from function_app.ports.blobs import MAX_BYTES, Blobs
from function_app.ports.tables import StoreError
from tests.contract.blobs.suite import Again, BlobsSuite, Direct
from tests.harness.stores.aws import Fault, Refusal, Wire, start_wire
from tests.harness.stores.azure import KEY, endpoint, start_azurite, through


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def connection() -> Iterator[str]:
    with start_azurite() as connection:
        yield connection


@pytest.fixture
def container() -> str:
    """A container of each test's own."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
async def blobs(connection: str, container: str) -> AsyncIterator[Blobs]:
    blobs = AzureBlobs(place=Place(connection), container=container)
    yield blobs
    await blobs.close()


@pytest.fixture
async def again(connection: str, container: str) -> AsyncIterator[Again]:
    opened: list[AzureBlobs] = []

    async def open_() -> Blobs:
        opened.append(AzureBlobs(place=Place(connection), container=container))
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


@pytest.fixture
async def direct(blobs: Blobs) -> AsyncIterator[Direct]:
    async with httpx.AsyncClient() as client:
        yield Direct(blobs, client, binds_length=False)


class TestAzureBlobs(BlobsSuite):
    pass


pytestmark = pytest.mark.anyio


@pytest.fixture
def wire(connection: str) -> Iterator[Wire]:
    with start_wire(endpoint(connection, "Blob")) as wire:
        yield wire


@pytest.fixture
async def spoilt(connection: str, wire: Wire, container: str, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Blobs]:
    """The same store over a wire that can be spoilt; its container is there."""
    monkeypatch.setattr(adapter, "RETRY_WITHIN_S", 0)
    blobs = AzureBlobs(place=Place(through(connection, wire.endpoint, "Blob")), container=container)
    await blobs.put("first", b"")
    yield blobs
    await blobs.close()


# ---------------------------------------------------------------- names and content


async def test_long_names_with_one_head_are_listed_in_order(blobs: Blobs) -> None:
    names = ["🤖" * 511 + letter for letter in ("🤕", "🦾", "a", "z", "ü")]
    names += ["🤖" * 245, "🤖" * 246, "🤖" * 400, "o", "~", "🤖"]
    for name in names:
        await blobs.put(name, name.encode())
        await blobs.append(name, b"!")
    names.sort()
    assert await blobs.list("") == tuple(names)
    assert await blobs.list("", limit=4) == tuple(names[:4])
    for prefix in ("🤖" * 246, "🤖" * 500, "🤖" * 511 + "a", "🤖" * 512):
        assert await blobs.list(prefix) == tuple(name for name in names if name.startswith(prefix))
    for name in names:
        assert await blobs.get(name) == name.encode() + b"!"
        await blobs.delete(name)
    assert await blobs.list("") == ()


async def test_a_list_goes_on_over_the_store_s_pages(blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "_PAGE", 3)
    names = tuple(f"n{number:02d}" for number in range(10))
    for name in names:
        await blobs.put(name, b"")
    assert await blobs.list("n") == names
    assert await blobs.list("n", limit=7) == names[:7]
    assert await blobs.list("n", limit=0) == ()


async def test_many_appends_become_one_block_and_lose_nothing(
    blobs: Blobs, again: Again, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "MANY_BLOCKS", 6)
    monkeypatch.setattr(adapter, "KEPT_BLOCKS", 2)
    other = await again()
    await blobs.put("log", b"begin,")
    for number in range(20):
        await (blobs, other)[number % 2].append("log", b"%d," % number)
    assert await blobs.get("log") == b"begin," + b"".join(b"%d," % number for number in range(20))


async def test_the_largest_blob_is_put_got_and_appended_to_whole(blobs: Blobs) -> None:
    content = bytes(range(256)) * (MAX_BYTES // 256)
    await blobs.put("a", content[:-5])
    assert await blobs.get("a") == content[:-5]
    await blobs.append("a", content[-5:-1])
    await blobs.append("a", content[-1:])
    assert await blobs.get("a") == content


# ---------------------------------------------------------------- answers that get lost


@pytest.mark.parametrize("fault", ["lose answer", "lose request"])
@pytest.mark.parametrize("there", [False, True])
async def test_an_append_is_done_once_though_the_wire_fails(
    spoilt: Blobs, blobs: Blobs, wire: Wire, there: bool, fault: Fault
) -> None:
    for number in range(7):  # more than an append has requests
        await (blobs.put if there else blobs.append)(f"log{number}", b"old,")
        faults: list[Fault] = ["pass"] * number
        wire.spoil(*faults, fault)
        await spoilt.append(f"log{number}", b"new")
        wire.faults.clear()
        assert await blobs.get(f"log{number}") == b"old,new"
        wire.spoil(*faults[1:], fault)
        await spoilt.append(f"new{number}", b"new")
        wire.faults.clear()
        assert await blobs.get(f"new{number}") == b"new"


@pytest.mark.parametrize("fault", ["lose answer", "lose request", "cut answer", Refusal(500, "InternalError", {})])
async def test_the_other_calls_are_sent_again(spoilt: Blobs, blobs: Blobs, wire: Wire, fault: Fault) -> None:
    wire.spoil(fault)
    await spoilt.put("a", b"1")
    assert await blobs.get("a") == b"1"
    wire.spoil(fault)
    assert await spoilt.get("a") == b"1"
    wire.spoil(fault)
    assert await spoilt.list("") == ("a", "first")
    wire.spoil(fault)
    await spoilt.delete("a")
    assert await blobs.get("a") is None


def meanwhile(writing: Coroutine[Any, Any, None]) -> Callable[[], None]:
    """Lets another write while a request waits on the wire."""
    loop = asyncio.get_running_loop()
    return lambda: asyncio.run_coroutine_threadsafe(writing, loop).result(20)


async def test_an_append_loses_nothing_that_others_write_meanwhile(spoilt: Blobs, blobs: Blobs, wire: Wire) -> None:
    for number in range(4):
        passed: list[Fault] = ["pass"] * number
        wire.spoil(*passed, meanwhile(blobs.append("log", b"a%d," % number)))
        await spoilt.append("log", b"b%d," % number)
        assert not wire.faults
    parts = (await blobs.get("log") or b"").split(b",")
    assert sorted(parts) == [b"", b"a0", b"a1", b"a2", b"a3", b"b0", b"b1", b"b2", b"b3"]


async def test_an_append_goes_to_what_was_put_meanwhile(spoilt: Blobs, blobs: Blobs, wire: Wire) -> None:
    for number in range(4):
        await blobs.put("a", b"old")
        passed: list[Fault] = ["pass"] * number
        wire.spoil(*passed, meanwhile(blobs.put("a", b"new")))
        await spoilt.append("a", b"!")
        assert await blobs.get("a") == b"new!"
    wire.spoil("pass", meanwhile(blobs.delete("a")))
    await spoilt.append("a", b"!")
    assert await blobs.get("a") == b"!"


# ---------------------------------------------------------------- what can be wrong


async def test_nothing_is_opened_before_the_first_call() -> None:
    blobs = AzureBlobs(place=Place("nonsense"), container="test")
    await blobs.close()
    await blobs.close()


async def test_before_the_first_writing_there_is_nothing(blobs: Blobs) -> None:
    assert await blobs.get("a") is None
    assert await blobs.list("") == ()
    await blobs.delete("a")
    await blobs.append("a", b"1")
    assert await blobs.get("a") == b"1"


@pytest.mark.parametrize(
    ("connection_string", "says"),
    [
        ("nonsense", "Check TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=bm8=;BlobEndpoint=http://127.0.0.1:1/a", "cannot be reached"),
        ("AccountName=a;AccountKey=no;BlobEndpoint=http://127.0.0.1:1/a", "Check TELESCOPE_STORAGE_CONNECTION"),
    ],
)
async def test_a_wrong_connection_is_said_in_one_line(connection_string: str, says: str) -> None:
    blobs = AzureBlobs(place=Place(connection_string), container="test")
    for call in _calls(blobs):
        assert says in await _complaint(call)
    await blobs.close()


async def test_a_wrong_key_is_said_to_be(connection: str, container: str) -> None:
    blobs = AzureBlobs(place=Place(connection.replace(KEY, "d3Jvbmc=")), container=container)
    for call in _calls(blobs):
        text = await _complaint(call)
        assert "may not be used" in text
        assert "d3Jvbmc=" not in text
    await blobs.close()


async def test_a_store_that_goes_on_failing_is_said_to(spoilt: Blobs, wire: Wire) -> None:
    wire.spoil(*[Refusal(503, "ServerBusy", {})] * ATTEMPTS)
    assert "too much to do" in await _complaint(lambda: spoilt.get("a"))
    assert len(wire.asked) == ATTEMPTS
    wire.spoil(*[Refusal(502, "BadGateway", {}, "application/x-nonsense")] * ATTEMPTS)
    assert "cannot be used" in await _complaint(lambda: spoilt.get("a"))


def _calls(blobs: Blobs) -> tuple[Callable[[], Awaitable[object]], ...]:
    return (
        lambda: blobs.put("a", b""),
        lambda: blobs.append("a", b""),
        lambda: blobs.get("a"),
        lambda: blobs.delete("a"),
        lambda: blobs.list(""),
    )


async def _complaint(call: Callable[[], Awaitable[object]]) -> str:
    with pytest.raises(StoreError) as caught:
        await call()
    assert "\n" not in str(caught.value)
    return str(caught.value)
