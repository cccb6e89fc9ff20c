"""``AzureBlobs`` fulfils the contract of its port on Azurite."""

import asyncio
import itertools
import secrets
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any

import httpx
import pytest

from function_app.adapters.azure import blobs as adapter
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import Endpoint
from function_app.ports.blobs import MAX_BYTES, Blobs
from tests.contract.blobs.suite import Again, BlobsSuite, Direct
from tests.contract.conftest import Closing
from tests.harness.stores.aws import Fault, FaultProxy, Refusal, start_fault_proxy
from tests.harness.stores.azure import endpoint, through

pytestmark = pytest.mark.anyio


@pytest.fixture
def container() -> str:
    """A separate container per test."""
    return f"test{secrets.token_hex(8)}"


@pytest.fixture
def again(azurite: str, container: str, closing: Closing) -> Again:
    return lambda: closing(AzureBlobs(endpoint=Endpoint(azurite), container=container))


@pytest.fixture
def blobs(again: Again) -> Blobs:
    return again()


@pytest.fixture
async def direct(blobs: Blobs) -> AsyncIterator[Direct]:
    async with httpx.AsyncClient() as client:
        yield Direct(blobs, client, binds_length=False)


class TestAzureBlobs(BlobsSuite):
    pass


@pytest.fixture
def proxy(azurite: str) -> Iterator[FaultProxy]:
    with start_fault_proxy(endpoint(azurite, "Blob")) as proxy:
        yield proxy


@pytest.fixture
async def over_wire(
    azurite: str, proxy: FaultProxy, container: str, closing: Closing, monkeypatch: pytest.MonkeyPatch
) -> Blobs:
    """The same store over a proxy with faults; its container exists."""
    monkeypatch.setattr(adapter, "MAX_RETRY_PAUSE_S", 0)
    blobs = closing(AzureBlobs(endpoint=Endpoint(through(azurite, proxy.endpoint, "Blob")), container=container))
    await blobs.put("first", b"")
    return blobs


# ---------------------------------------------------------------- names and content


async def test_long_names_with_the_same_start_are_listed_in_order(blobs: Blobs) -> None:
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


async def test_a_list_continues_over_several_responses(blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "_PAGE", 3)
    names = tuple(f"n{number:02d}" for number in range(10))
    for name in names:
        await blobs.put(name, b"")
    assert await blobs.list("n") == names
    assert await blobs.list("n", limit=7) == names[:7]
    assert await blobs.list("n", limit=0) == ()


async def test_many_appends_are_merged_into_one_block(
    blobs: Blobs, again: Again, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "MANY_BLOCKS", 6)
    monkeypatch.setattr(adapter, "UNMERGED_BLOCKS", 2)
    await blobs.put("log", b"begin,")
    for number, instance in zip(range(20), itertools.cycle((blobs, again())), strict=False):
        await instance.append("log", b"%d," % number)
    assert await blobs.get("log") == b"begin," + b"".join(b"%d," % number for number in range(20))


async def test_the_largest_blob_is_written_read_and_appended_to(blobs: Blobs) -> None:
    content = bytes(range(256)) * (MAX_BYTES // 256)
    await blobs.put("a", content[:-5])
    await blobs.append("a", content[-5:-1])
    await blobs.append("a", content[-1:])
    assert await blobs.get("a") == content


async def test_nothing_exists_before_the_first_write(blobs: Blobs) -> None:
    assert await blobs.get("a") is None
    assert await blobs.list("") == ()
    await blobs.delete("a")
    await blobs.append("a", b"1")
    assert await blobs.get("a") == b"1"


# ---------------------------------------------------------------- lost requests and responses


@pytest.mark.parametrize("fault", ["lose response", "lose request"])
@pytest.mark.parametrize("exists", [False, True])
async def test_an_append_is_applied_once_despite_connection_errors(
    over_wire: Blobs, blobs: Blobs, proxy: FaultProxy, exists: bool, fault: Fault
) -> None:
    for number in range(7):  # more than the requests of an append
        await (blobs.put if exists else blobs.append)(f"log{number}", b"old,")
        faults: list[Fault] = ["pass"] * number
        proxy.inject(*faults, fault)
        await over_wire.append(f"log{number}", b"new")
        proxy.faults.clear()
        assert await blobs.get(f"log{number}") == b"old,new"
        proxy.inject(*faults[1:], fault)
        await over_wire.append(f"new{number}", b"new")
        proxy.faults.clear()
        assert await blobs.get(f"new{number}") == b"new"


@pytest.mark.parametrize("fault", ["lose response", "lose request", "cut response", Refusal(500, "InternalError", {})])
async def test_the_other_calls_are_sent_again(over_wire: Blobs, blobs: Blobs, proxy: FaultProxy, fault: Fault) -> None:
    proxy.inject(fault)
    await over_wire.put("a", b"1")
    assert await blobs.get("a") == b"1"
    proxy.inject(fault)
    assert await over_wire.get("a") == b"1"
    proxy.inject(fault)
    assert await over_wire.list("") == ("a", "first")
    proxy.inject(fault)
    await over_wire.delete("a")
    assert await blobs.get("a") is None


def meanwhile(write: Coroutine[Any, Any, None]) -> Callable[[], None]:
    """Lets another client write while a request waits on the proxy."""
    loop = asyncio.get_running_loop()
    return lambda: asyncio.run_coroutine_threadsafe(write, loop).result(20)


async def test_an_append_preserves_concurrent_writes(over_wire: Blobs, blobs: Blobs, proxy: FaultProxy) -> None:
    for number in range(4):
        passed: list[Fault] = ["pass"] * number
        proxy.inject(*passed, meanwhile(blobs.append("log", b"a%d," % number)))
        await over_wire.append("log", b"b%d," % number)
        assert not proxy.faults
        await blobs.put("a", b"old")
        proxy.inject(*passed, meanwhile(blobs.put("a", b"new")))
        await over_wire.append("a", b"!")
        assert await blobs.get("a") == b"new!"
    parts = (await blobs.get("log") or b"").split(b",")
    assert sorted(parts) == [b"", b"a0", b"a1", b"a2", b"a3", b"b0", b"b1", b"b2", b"b3"]
    proxy.inject("pass", meanwhile(blobs.delete("a")))
    await over_wire.append("a", b"!")
    assert await blobs.get("a") == b"!"
