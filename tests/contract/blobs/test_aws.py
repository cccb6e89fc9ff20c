"""``S3Blobs`` fulfils the contract of its port on moto."""

import asyncio
import hashlib
import hmac
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import unquote

import httpx
import pytest
from botocore.session import Session
from hypothesis import given, settings
from hypothesis import strategies as st

from function_app.adapters.aws import blobs as adapter
from function_app.adapters.aws import names
from function_app.adapters.aws.blobs import S3Blobs, decode, encode
from function_app.adapters.shared import appending
from function_app.ports.blobs import Blobs
from function_app.ports.tables import StoreError
from tests.contract.blobs.suite import PNG, Again, BlobsSuite, Direct
from tests.contract.conftest import Closing
from tests.harness.stores.aws import REGION, FaultProxy, Refusal, reset, start_fault_proxy, use_credentials

Open = Callable[[str], S3Blobs]
NAME = "telescope"
CONFLICT = Refusal(412, "PreconditionFailed", {})

pytestmark = pytest.mark.anyio


@pytest.fixture(scope="module")
def warm(moto: str) -> Iterator[S3Blobs]:
    """Shared by all tests: creating a client of the SDK is slow."""
    blobs = S3Blobs(bucket=NAME, region=REGION, endpoint=moto)
    yield blobs
    asyncio.run(blobs.close())


@pytest.fixture
async def blobs(warm: S3Blobs, moto: str) -> Blobs:
    reset(moto)
    await warm.prepare()
    return warm


@pytest.fixture
def open_at(closing: Closing) -> Open:
    """Opens the bucket at an endpoint."""
    return lambda address: closing(S3Blobs(bucket=NAME, region=REGION, endpoint=address))


@pytest.fixture
def again(open_at: Open, moto: str) -> Again:
    return lambda: open_at(moto)


@pytest.fixture
def proxy(moto: str) -> Iterator[FaultProxy]:
    with start_fault_proxy(moto) as proxy:
        yield proxy


@pytest.fixture
async def over_wire(blobs: Blobs, open_at: Open, proxy: FaultProxy) -> Blobs:
    """The same bucket over a proxy with faults, after its first call."""
    over_wire = open_at(proxy.endpoint)
    assert await over_wire.list("") == await blobs.list("")
    return over_wire


@pytest.fixture
async def direct(over_wire: Blobs, proxy: FaultProxy) -> AsyncIterator[Direct]:
    """A proxy that verifies signatures by the documented rules of AWS, which moto does not."""
    proxy.guard = check_signature
    async with httpx.AsyncClient() as client:
        yield Direct(over_wire, client)


def check_signature(method: str, path: str, headers: Mapping[str, str]) -> Refusal | None:
    """Rejects a presigned request that differs from the signed one (Signature Version 4, query parameters)."""
    given = {name.lower(): value.strip() for name, value in headers.items()}
    address, _, text = path.partition("?")
    query = dict(part.partition("=")[::2] for part in text.split("&") if part)
    signature = query.pop("X-Amz-Signature", None)
    if signature is None:
        return None if "authorization" in given else Refusal(403, "AccessDenied", {})
    signed_at = datetime.strptime(query["X-Amz-Date"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    if datetime.now(UTC) > signed_at + timedelta(seconds=int(query["X-Amz-Expires"])):
        return Refusal(403, "AccessDenied", {})
    names = unquote(query["X-Amz-SignedHeaders"]).split(";")
    lines = [f"{name}:{given.get(name, '')}" for name in names]
    request = [method, address, "&".join(f"{key}={query[key]}" for key in sorted(query)), *lines, "", ";".join(names)]
    digest = hashlib.sha256("\n".join([*request, "UNSIGNED-PAYLOAD"]).encode()).hexdigest()
    _, *scope = unquote(query["X-Amz-Credential"]).split("/")
    key = b"AWS4testing"
    for word in scope:
        key = hmac.digest(key, word.encode(), "sha256")
    signed = "\n".join(["AWS4-HMAC-SHA256", query["X-Amz-Date"], "/".join(scope), digest])
    valid = hmac.new(key, signed.encode(), "sha256").hexdigest() == signature
    return None if valid else Refusal(403, "SignatureDoesNotMatch", {})


class TestS3Blobs(BlobsSuite):
    pass


async def test_presigned_urls_name_the_buckets_region(monkeypatch: pytest.MonkeyPatch, closing: Closing) -> None:
    """S3 redirects requests at its global endpoint, and a signature is valid for one host."""
    use_credentials(monkeypatch)
    for bucket, host in ((NAME, f"{NAME}.s3.eu-west-1.amazonaws.com"), ("a.b", "s3.eu-west-1.amazonaws.com/a.b")):
        blobs = closing(S3Blobs(bucket=bucket, region="eu-west-1"))
        upload = await blobs.presign_upload("up", length=3, content_type=PNG, lifetime_s=60)
        assert upload.url.startswith(f"https://{host}/up?")
        assert "content-length%3Bcontent-type%3Bhost%3Bif-none-match" in upload.url


# ---------------------------------------------------------------- names

START = "🤖" * (names.HEAD + 100)
LONG = [START + end for end in ("", "\x00", "0", "1", "20", "21", "ü", "\U0010ffff")]
BETWEEN = [START[: names.HEAD - 1], START[: names.HEAD], START[: names.HEAD - 1] + "🤗", "\U0010ffff", "a"]


async def test_long_names_with_the_same_start_are_listed_in_order(
    blobs: Blobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_PAGE", 3)
    everything = sorted([*LONG, *BETWEEN])
    for name in reversed(everything):
        await blobs.put(name, name.encode())
    for limit in range(len(everything) + 2):
        assert await blobs.list("", limit=limit) == tuple(everything[:limit])
    for prefix in (LONG[0], LONG[2], LONG[4][:-1], BETWEEN[0], START + "none"):
        matching = tuple(name for name in everything if name.startswith(prefix))
        assert await blobs.list(prefix) == matching
        assert await blobs.list(prefix, limit=3) == matching[:3]
    for name in everything:
        await blobs.append(name, b"!")
        assert await blobs.get(name) == name.encode() + b"!"
    assert await blobs.list("") == tuple(everything)


TEXT = st.text(max_size=names.HEAD)
SPECIAL = st.lists(st.sampled_from(["/", ".", "..", "!", "a", " ", "\x00", "0", "ü", "_"])).map("".join)


@given(one=TEXT | SPECIAL, other=TEXT | SPECIAL)
@settings(max_examples=200)
def test_keys_are_reversible_and_preserve_order_and_prefixes(one: str, other: str) -> None:
    keys = encode(one), encode(other)
    assert (decode(keys[0]), decode(keys[1])) == (one, other)
    assert (keys[0].encode() < keys[1].encode()) == (one.encode() < other.encode())
    assert keys[0].startswith(keys[1]) == one.startswith(other)
    assert len(keys[0].encode()) <= 4 * names.HEAD
    assert not {".", ".."} & set(keys[0].split("/"))
    assert keys[0].isprintable() or not one.isascii() or "\x7f" in one


# ---------------------------------------------------------------- lost requests and responses


async def test_an_append_is_applied_once_despite_connection_errors(
    blobs: Blobs, over_wire: Blobs, proxy: FaultProxy
) -> None:
    for number in range(2):
        proxy.inject("pass", "lose response")
        await over_wire.append("log", b"%d" % number)
        assert proxy.operations == ["GET", "PUT", "PUT", "GET"]
    for number in range(2, 4):
        proxy.inject("pass", "lose request")
        await over_wire.append("log", b"%d" % number)
    assert await blobs.get("log") == b"0123"


def meanwhile(write: Coroutine[Any, Any, None]) -> Callable[[], None]:
    """Lets another client write before a request arrives."""
    loop = asyncio.get_running_loop()
    return lambda: asyncio.run_coroutine_threadsafe(write, loop).result()


async def test_an_append_preserves_concurrent_writes(blobs: Blobs, over_wire: Blobs, proxy: FaultProxy) -> None:
    proxy.inject("pass", meanwhile(blobs.append("log", b"0")), "pass", meanwhile(blobs.append("log", b"1")))
    await over_wire.append("log", b"2")
    assert await blobs.get("log") == b"012"
    proxy.inject("pass", "lose request", meanwhile(blobs.append("log", b"3")))
    await over_wire.append("log", b"4")
    assert await blobs.get("log") == b"01234"
    proxy.inject("pass", meanwhile(blobs.delete("log")))
    await over_wire.append("log", b"5")
    assert await blobs.get("log") == b"5"


async def test_an_append_is_retried_after_a_conflict(blobs: Blobs, over_wire: Blobs, proxy: FaultProxy) -> None:
    await blobs.append("log", b"0")
    proxy.inject("pass", CONFLICT, "pass", Refusal(409, "ConditionalRequestConflict", {}))
    await over_wire.append("log", b"1")
    assert proxy.operations == ["GET", "PUT"] * 3
    assert await blobs.get("log") == b"01"


async def test_an_append_that_always_conflicts_is_an_error(
    over_wire: Blobs, proxy: FaultProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(appending, "_LONGEST_PAUSE_S", 0.001)
    for _ in range(appending.TRIES):
        proxy.faults.extend(("pass", CONFLICT))
    with pytest.raises(StoreError, match=r"'log'\. Try again"):
        await over_wire.append("log", b"1")
    assert await over_wire.get("log") is None


# ---------------------------------------------------------------- prepare


async def test_prepare_and_close_are_idempotent(blobs: Blobs, open_at: Open, moto: str) -> None:
    await blobs.put("a", b"1")
    await asyncio.gather(*(open_at(moto).prepare() for _ in range(4)))
    for _ in range(2):
        await blobs.close()
    assert await blobs.get("a") == b"1"


@pytest.mark.usefixtures("blobs")
async def test_prepare_permits_the_console_to_read_and_keeps_other_rules(open_at: Open, moto: str) -> None:
    client = Session().create_client("s3", region_name=REGION, endpoint_url=moto)
    for origin in ("https://console.example", "https://other.example"):
        await open_at(moto).prepare(console=origin)
        rules = client.get_bucket_cors(Bucket=NAME)["CORSRules"]
        assert rules == [{"AllowedOrigins": ["https://console.example"], "AllowedMethods": ["GET"]}]


async def test_a_bucket_can_be_created_in_us_east_1(moto: str, closing: Closing) -> None:
    reset(moto)
    blobs = closing(S3Blobs(bucket="first", region="us-east-1", endpoint=moto))
    await blobs.prepare()
    await blobs.put("a", b"1")
    assert await blobs.list("") == ("a",)
