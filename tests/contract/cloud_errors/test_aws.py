"""Errors of DynamoDB and S3 as reported by tables and blobs."""

import socket
from collections.abc import Awaitable, Callable

import pytest

from function_app.adapters.aws.blobs import S3Blobs
from function_app.adapters.aws.client import ATTEMPTS
from function_app.adapters.aws.tables import DynamoTables
from function_app.ports.tables import Row, StoreError, Write
from tests.contract.conftest import Closing
from tests.harness.stores.aws import HOST, REGION, Refusal, reset, start_fault_proxy

NAME = "telescope"
Calls = tuple[Callable[[], Awaitable[object]], ...]
OpenStore = Callable[..., Calls]

pytestmark = pytest.mark.anyio


def table_calls(tables: DynamoTables) -> Calls:
    row = Row("p", "k", {}, "etag")
    return (
        lambda: tables.get("T", "p", "k"),
        lambda: tables.create("T", row),
        lambda: tables.replace("T", row),
        lambda: tables.delete("T", row),
        lambda: tables.query("T", "p"),
        lambda: tables.batch("T", [Write("create", row), Write("create", Row("p", "other"))]),
    )


def blob_calls(blobs: S3Blobs) -> Calls:
    return (
        lambda: blobs.get("a"),
        lambda: blobs.put("a", b"1"),
        lambda: blobs.append("a", b"1"),
        lambda: blobs.delete("a"),
        lambda: blobs.list(""),
    )


@pytest.fixture(params=["dynamodb", "s3"])
def service(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def open_store(service: str, moto: str, closing: Closing) -> OpenStore:
    """Calls of a new adapter of the service; no table and no bucket exists."""
    reset(moto)

    def open_store(address: str = moto) -> Calls:
        if service == "dynamodb":
            return table_calls(closing(DynamoTables(table=NAME, region=REGION, endpoint=address)))
        return blob_calls(closing(S3Blobs(bucket=NAME, region=REGION, endpoint=address)))

    return open_store


async def test_a_missing_table_or_bucket_is_named(service: str, open_store: OpenStore) -> None:
    hint = "TELESCOPE_AWS_TABLE.*sort key 'k'" if service == "dynamodb" else "TELESCOPE_AWS_BUCKET.*or create it with"
    for call in open_store():
        with pytest.raises(StoreError, match=f"'{NAME}' in {REGION}.* does not exist.*{hint}"):
            await call()


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("AccessDenied", "denied access.*Check the credentials"),
        ("AccessDeniedException", "denied access.*Check the credentials"),
        ("SignatureDoesNotMatch", "denied access.*Check the credentials"),
        ("UnrecognizedClientException", "denied access.*Check the credentials"),
        ("ValidationException", "cannot be used: .*ValidationException"),
    ],
)
async def test_an_error_is_reported_in_one_line_and_not_retried(
    open_store: OpenStore, moto: str, code: str, expected: str
) -> None:
    with start_fault_proxy(moto) as proxy:
        for call in open_store(proxy.endpoint):
            proxy.inject(Refusal(403, code, {}))
            with pytest.raises(StoreError, match=f"'{NAME}'.*{expected}") as caught:
                await call()
            assert "\n" not in str(caught.value)
            assert len(proxy.requests) == 1


async def test_a_throttled_call_is_retried_a_few_times(open_store: OpenStore, moto: str) -> None:
    with start_fault_proxy(moto) as proxy:
        get, *_ = open_store(proxy.endpoint)
        proxy.inject(*[Refusal(400, "ThrottlingException", {})] * ATTEMPTS)
        with pytest.raises(StoreError, match=r"is overloaded.*Try again"):
            await get()
        assert len(proxy.requests) == ATTEMPTS


async def test_an_unreachable_address_is_named(open_store: OpenStore) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        address = f"http://{HOST}:{taken.getsockname()[1]}"
        get, *_ = open_store(address)
        with pytest.raises(StoreError, match=f"at {address} cannot be reached.*Check TELESCOPE_AWS_ENDPOINT and"):
            await get()


async def test_missing_credentials_are_reported(open_store: OpenStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    get, *_ = open_store()
    with pytest.raises(StoreError, match=r"Unable to locate credentials\. Give this program a role, or set AWS_ACCESS"):
        await get()


async def test_an_s3_response_that_ends_early_is_an_error(moto: str, closing: Closing) -> None:
    reset(moto)
    with start_fault_proxy(moto) as proxy:
        blobs = closing(S3Blobs(bucket=NAME, region=REGION, endpoint=proxy.endpoint))
        await blobs.prepare()
        await blobs.put("a", bytes(100_000))
        proxy.inject("cut response")
        with pytest.raises(StoreError, match=f"bucket '{NAME}'"):
            await blobs.get("a")
        assert await blobs.get("a") == bytes(100_000)
