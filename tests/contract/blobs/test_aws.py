"""``S3Blobs`` keeps the port's promises over moto, and says clearly what is wrong with the real thing."""

import asyncio
import hashlib
import hmac
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import unquote

import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from function_app.adapters.aws import blobs as adapter
from function_app.adapters.aws import names
from function_app.adapters.aws.blobs import TRIES, S3Blobs, decode, encode
from function_app.ports.blobs import Blobs
from function_app.ports.tables import StoreError
from tests.contract.blobs.suite import Again, BlobsSuite, Direct
from tests.harness.stores.aws import HOST, REGION, Refusal, Wire, reset, start_moto, start_wire, use_credentials

Open = Callable[..., S3Blobs]
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
def warm(endpoint: str) -> Iterator[S3Blobs]:
    """One for all tests: the SDK takes long to make a client."""
    blobs = S3Blobs(bucket=NAME, region=REGION, endpoint=endpoint)
    yield blobs
    asyncio.run(blobs.close())


@pytest.fixture
async def blobs(warm: S3Blobs, endpoint: str) -> Blobs:
    reset(endpoint)
    await warm.prepare()
    return warm


@pytest.fixture
async def opened(endpoint: str) -> AsyncIterator[Open]:
    """Makes more, of other places too."""
    made: list[S3Blobs] = []

    def open_(*, bucket: str = NAME, at: str = endpoint) -> S3Blobs:
        made.append(S3Blobs(bucket=bucket, region=REGION, endpoint=at))
        return made[-1]

    yield open_
    for each in made:
        await each.close()


@pytest.fixture
def again(opened: Open) -> Again:
    async def open_() -> Blobs:
        return opened()

    return open_


@pytest.fixture
async def direct(blobs: Blobs, opened: Open, wire: Wire) -> AsyncIterator[Direct]:
    """By a wire that checks signatures as Amazon documents them, which moto does not."""
    assert await blobs.list("") == ()
    wire.guard = signed
    async with httpx.AsyncClient() as client:
        yield Direct(opened(at=wire.endpoint), client)


def signed(method: str, path: str, headers: Mapping[str, str]) -> Refusal | None:
    """Whether a presigned request is what was signed (Signature Version 4, query parameters)."""
    given = {name.lower(): value.strip() for name, value in headers.items()}
    address, _, text = path.partition("?")
    query = dict(part.partition("=")[::2] for part in text.split("&") if part)
    signature = query.pop("X-Amz-Signature", None)
    if signature is None:
        return None if "authorization" in given else Refusal(403, "AccessDenied", {})
    made = datetime.strptime(query["X-Amz-Date"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    if datetime.now(UTC) > made + timedelta(seconds=int(query["X-Amz-Expires"])):
        return Refusal(403, "AccessDenied", {})
    names = unquote(query["X-Amz-SignedHeaders"]).split(";")
    lines = [f"{name}:{given.get(name, '')}" for name in names]
    asked = [method, address, "&".join(f"{key}={query[key]}" for key in sorted(query)), *lines, "", ";".join(names)]
    digest = hashlib.sha256("\n".join([*asked, "UNSIGNED-PAYLOAD"]).encode()).hexdigest()
    _, *scope = unquote(query["X-Amz-Credential"]).split("/")
    key = b"AWS4testing"
    for word in scope:
        key = hmac.digest(key, word.encode(), "sha256")
    told = "\n".join(["AWS4-HMAC-SHA256", query["X-Amz-Date"], "/".join(scope), digest])
    right = hmac.new(key, told.encode(), "sha256").hexdigest() == signature
    return None if right else Refusal(403, "SignatureDoesNotMatch", {})


class TestS3Blobs(BlobsSuite):
    pass


@pytest.fixture
def wire(endpoint: str) -> Iterator[Wire]:
    """A way to the emulator that can be spoilt."""
    with start_wire(endpoint) as wire:
        yield wire


@pytest.fixture
async def through(blobs: Blobs, opened: Open, wire: Wire) -> Blobs:
    """A store at the end of ``wire``, which has been used once."""
    through = opened(at=wire.endpoint)
    assert await through.list("") == await blobs.list("")
    return through


async def test_addresses_name_the_buckets_region(monkeypatch: pytest.MonkeyPatch) -> None:
    """S3 redirects what goes to its general address, and a signature is good for one host only."""
    use_credentials(monkeypatch)
    for bucket, host in ((NAME, f"{NAME}.s3.eu-west-1.amazonaws.com"), ("a.b", "s3.eu-west-1.amazonaws.com/a.b")):
        blobs = S3Blobs(bucket=bucket, region="eu-west-1")
        upload = await blobs.presign_upload("up", length=3, content_type="image/png", lifetime_s=60)
        assert upload.url.startswith(f"https://{host}/up?")
        assert "content-length%3Bcontent-type%3Bhost%3Bif-none-match" in upload.url
        await blobs.close()


# ---------------------------------------------------------------- names

SHARED = "🤖" * (names.HEAD + 100)
LONG = [SHARED + tail for tail in ("", "\x00", "0", "1", "20", "21", "ü", "\U0010ffff")]
BETWEEN = [SHARED[: names.HEAD - 1], SHARED[: names.HEAD], SHARED[: names.HEAD - 1] + "🤗", "\U0010ffff", "a"]


async def test_long_names_with_one_beginning_are_listed_as_all_others(
    blobs: Blobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_PAGE", 3)
    everything = sorted([*LONG, *BETWEEN])
    for name in reversed(everything):
        await blobs.put(name, name.encode())
    for limit in range(len(everything) + 2):
        assert await blobs.list("", limit=limit) == tuple(everything[:limit])
    for prefix in (LONG[0], LONG[2], LONG[4][:-1], BETWEEN[0], SHARED + "none"):
        inside = [name for name in everything if name.startswith(prefix)]
        assert await blobs.list(prefix) == tuple(inside)
        assert await blobs.list(prefix, limit=3) == tuple(inside[:3])
    for name in everything:
        await blobs.append(name, b"!")
        assert await blobs.get(name) == name.encode() + b"!"
    assert await blobs.list("") == tuple(everything)


async def test_more_names_than_s3_lists_at_once_are_listed(blobs: Blobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "_PAGE", 10)
    everything = tuple(f"n{number:02d}" for number in range(35))
    for name in everything:
        await blobs.put(name, b"")
    assert await blobs.list("") == everything
    assert await blobs.list("n", limit=25) == everything[:25]


text = st.text(max_size=names.HEAD)
written = st.one_of(
    text, st.lists(st.sampled_from(["/", ".", "..", "!", "a", " ", "\x00", "0", "ü", "_"])).map("".join)
)


@given(one=written, other=written)
@settings(max_examples=500)
def test_keys_sort_and_begin_as_names_do_and_mean_one_name_each(one: str, other: str) -> None:
    keys = encode(one), encode(other)
    assert (decode(keys[0]), decode(keys[1])) == (one, other)
    assert (keys[0].encode() < keys[1].encode()) == (one.encode() < other.encode())
    assert keys[0].startswith(keys[1]) == one.startswith(other)
    assert len(keys[0].encode()) <= 4 * names.HEAD
    assert not {".", ".."} & set(keys[0].split("/"))
    assert keys[0].isprintable() or not one.isascii() or "\x7f" in one


# ---------------------------------------------------------------- lost requests and answers


async def test_an_append_whose_answer_was_lost_is_there_once(blobs: Blobs, through: Blobs, wire: Wire) -> None:
    for number in range(2):
        wire.spoil("pass", "lose answer")
        await through.append("log", b"%d" % number)
        assert wire.operations == ["GET", "PUT", "PUT", "GET"]
    assert await blobs.get("log") == b"01"


async def test_an_append_that_never_arrived_is_made_once(blobs: Blobs, through: Blobs, wire: Wire) -> None:
    for number in range(2):
        wire.spoil("pass", "lose request")
        await through.append("log", b"%d" % number)
    assert await blobs.get("log") == b"01"


def meanwhile(writing: Coroutine[Any, Any, None]) -> Callable[[], None]:
    """A concurrent write, before a request arrives."""
    loop = asyncio.get_running_loop()
    return lambda: asyncio.run_coroutine_threadsafe(writing, loop).result()


async def test_an_append_loses_nothing_that_others_write_meanwhile(blobs: Blobs, through: Blobs, wire: Wire) -> None:
    wire.spoil("pass", meanwhile(blobs.append("log", b"0")), "pass", meanwhile(blobs.append("log", b"1")))
    await through.append("log", b"2")
    assert await blobs.get("log") == b"012"
    wire.spoil("pass", meanwhile(blobs.delete("log")))
    await through.append("log", b"3")
    assert await blobs.get("log") == b"3"


async def test_an_append_that_was_lost_is_not_taken_for_what_others_write(
    blobs: Blobs, through: Blobs, wire: Wire
) -> None:
    await blobs.append("log", b"0")
    wire.spoil("pass", "lose request", meanwhile(blobs.append("log", b"1")))
    await through.append("log", b"2")
    assert await blobs.get("log") == b"012"


async def test_an_append_begins_anew_when_another_was_quicker(blobs: Blobs, through: Blobs, wire: Wire) -> None:
    await blobs.append("log", b"0")
    wire.spoil("pass", Refusal(412, "PreconditionFailed", {}), "pass", Refusal(409, "ConditionalRequestConflict", {}))
    await through.append("log", b"1")
    assert wire.operations == ["GET", "PUT"] * 3
    assert await blobs.get("log") == b"01"


async def test_an_append_that_others_never_let_through_is_said_to_be(
    through: Blobs, wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "_LONGEST_PAUSE_S", 0.001)
    for _ in range(TRIES):
        wire.faults.extend(("pass", Refusal(412, "PreconditionFailed", {})))
    with pytest.raises(StoreError, match=r"'log' at once\. Try again"):
        await through.append("log", b"1")
    assert await through.get("log") is None


# ---------------------------------------------------------------- what can be wrong


@pytest.mark.usefixtures("blobs")
async def test_a_bucket_that_is_not_there_is_named(opened: Open) -> None:
    for call in calls(opened(bucket="absent")):
        with pytest.raises(
            StoreError, match=f"'absent' in {REGION}.* does not exist.*TELESCOPE_AWS_BUCKET.*or create it"
        ):
            await call()


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("AccessDenied", "may not be used.*Check the credentials"),
        ("SignatureDoesNotMatch", "may not be used.*Check the credentials"),
        ("InvalidRequest", "cannot be used: .*InvalidRequest"),
    ],
)
async def test_a_refusal_is_said_in_one_line(through: Blobs, wire: Wire, code: str, says: str) -> None:
    for call in calls(through):
        wire.spoil(Refusal(403, code, {}))
        with pytest.raises(StoreError, match=f"bucket '{NAME}'.*{says}") as caught:
            await call()
        assert "\n" not in str(caught.value)
        assert len(wire.asked) == 1


async def test_an_answer_that_ends_in_the_middle_is_an_error(blobs: Blobs, through: Blobs, wire: Wire) -> None:
    await blobs.put("a", bytes(100_000))
    wire.spoil("cut answer")
    with pytest.raises(StoreError, match=f"bucket '{NAME}'"):
        await through.get("a")
    assert await through.get("a") == bytes(100_000)


async def test_an_unreachable_address_is_named(opened: Open) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        address = f"http://{HOST}:{taken.getsockname()[1]}"
        with pytest.raises(StoreError, match=f"at {address} cannot be reached.*Check TELESCOPE_AWS_ENDPOINT and"):
            await opened(at=address).get("a")


async def test_missing_credentials_are_said_to_be(opened: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    with pytest.raises(StoreError, match=r"Unable to locate credentials\. Give this program a role, or set AWS_ACCESS"):
        await opened().get("a")


async def test_preparing_is_safe_to_repeat_and_keeps_blobs(blobs: Blobs, opened: Open) -> None:
    await blobs.put("a", b"1")
    await asyncio.gather(*(opened().prepare() for _ in range(4)))
    assert await blobs.get("a") == b"1"


async def test_a_bucket_in_amazons_first_region_can_be_made(endpoint: str) -> None:
    first = S3Blobs(bucket="first", region="us-east-1", endpoint=endpoint)
    await first.prepare()
    await first.put("a", b"1")
    assert await first.list("") == ("a",)
    await first.close()


async def test_closing_may_be_repeated_and_it_opens_again(blobs: Blobs) -> None:
    await blobs.put("a", b"1")
    await blobs.close()
    await blobs.close()
    assert await blobs.get("a") == b"1"


def calls(blobs: Blobs) -> tuple[Callable[[], Awaitable[object]], ...]:
    return (
        lambda: blobs.put("a", b"1"),
        lambda: blobs.get("a"),
        lambda: blobs.append("a", b"1"),
        lambda: blobs.delete("a"),
        lambda: blobs.list(""),
    )
