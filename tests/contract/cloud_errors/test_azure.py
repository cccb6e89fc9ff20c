"""Errors of an Azure storage account and of the functions' identity, as reported by tables and blobs."""

import itertools
import secrets
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from function_app.adapters.azure import blobs as adapter
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import ATTEMPTS, Endpoint
from function_app.adapters.azure.sas_keys import SasKeys
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import Row, StoreError
from tests.contract.conftest import Closing
from tests.harness.cloud.identity import (
    HOST,
    OBJECT_ID,
    SECRET,
    TENANT_ID,
    IdentityEndpoint,
    make_certificate,
    start_identity_endpoint,
)
from tests.harness.stores.aws import Refusal, start_fault_proxy
from tests.harness.stores.azure import KEY, endpoint, start_azurite, through

CLIENT_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"
WRONG_KEY = "d3Jvbmc="
NONSENSE = {"Table": "invalid response", "Blob": "cannot be used"}
"""Expected error text for an unreadable response."""
Calls = tuple[Callable[[], Awaitable[object]], ...]
OpenStore = Callable[[Endpoint], Calls]

pytestmark = pytest.mark.anyio


def table_calls(tables: AzureTables) -> Calls:
    return (
        lambda: tables.create("T", Row("p", "k")),
        lambda: tables.query("T", "p"),
        lambda: tables.create("T", Row("p", secrets.token_hex(8))),
    )


def blob_calls(blobs: AzureBlobs) -> Calls:
    return (
        lambda: blobs.put("a", b""),
        lambda: blobs.append("a", b""),
        lambda: blobs.get("a"),
        lambda: blobs.delete("a"),
        lambda: blobs.list(""),
    )


@pytest.fixture(params=["Table", "Blob"])
def service(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def open_store(service: str, closing: Closing, monkeypatch: pytest.MonkeyPatch) -> OpenStore:
    """Calls of a new adapter of the service."""
    monkeypatch.setattr(adapter, "MAX_RETRY_PAUSE_S", 0)
    name = f"test{secrets.token_hex(8)}"
    if service == "Table":
        return lambda target: table_calls(closing(AzureTables(endpoint=target, prefix=name)))
    return lambda target: blob_calls(closing(AzureBlobs(endpoint=target, container=name)))


async def error_of(call: Callable[[], Awaitable[object]]) -> str:
    with pytest.raises(StoreError) as caught:
        await call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("connection", "expected"),
    [
        ("nonsense", "Check TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=", "Check TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=no;{}Endpoint=http://127.0.0.1:1/a", "Check TELESCOPE_STORAGE_CONNECTION"),
        ("AccountName=a;AccountKey=bm8=;{}Endpoint=http://127.0.0.1:1/a", "cannot be reached"),
    ],
)
async def test_an_invalid_connection_is_reported_at_each_call(
    service: str, open_store: OpenStore, connection: str, expected: str
) -> None:
    calls = open_store(Endpoint(connection.format(service)))
    for call in itertools.islice(itertools.cycle(calls), len(calls) + 1):
        text = await error_of(call)
        assert expected in text
        assert "AccountKey=" not in text


async def test_a_wrong_key_is_reported_but_not_shown(azurite: str, open_store: OpenStore) -> None:
    for call in open_store(Endpoint(azurite.replace(KEY, WRONG_KEY))):
        text = await error_of(call)
        assert "denied access" in text
        assert "Check TELESCOPE_STORAGE_CONNECTION" in text
        assert WRONG_KEY not in text


async def test_a_failing_store_is_retried_a_few_times(azurite: str, service: str, open_store: OpenStore) -> None:
    with start_fault_proxy(endpoint(azurite, service)) as proxy:
        calls = open_store(Endpoint(through(azurite, proxy.endpoint, service)))
        call = calls[2]
        await calls[0]()
        await call()
        for refusal, expected in (
            (Refusal(503, "ServerBusy", {}), "is overloaded"),
            (Refusal(500, "InternalError", {}), "cannot be used"),
            (Refusal(502, "BadGateway", {}, "application/x-nonsense"), NONSENSE[service]),
        ):
            proxy.inject(*[refusal] * ATTEMPTS)
            assert expected in await error_of(call)
            assert len(proxy.requests) == ATTEMPTS
        await call()


# ---------------------------------------------------------------- the functions' identity


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="module")
def secure_azurite(certificate: Path) -> Iterator[str]:
    """Azurite with TLS, which accepts tokens."""
    options = ("--oauth", "basic", "--cert", str(certificate), "--key", str(certificate.with_name("key.pem")))
    with start_azurite(*options) as connection:
        yield connection


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[IdentityEndpoint]:
    with start_identity_endpoint(monkeypatch, certificate) as host:
        yield host


@pytest.mark.parametrize("identity", ["", CLIENT_ID], ids=["the host's", "another"])
async def test_tables_and_blobs_are_used_with_the_identity(
    secure_azurite: str, host: IdentityEndpoint, closing: Closing, identity: str
) -> None:
    endpoints = {name: Endpoint(url=endpoint(secure_azurite, name), identity=identity) for name in ("Table", "Blob")}
    tables = closing(AzureTables(endpoint=endpoints["Table"], prefix="test"))
    row = await tables.create("T", Row(f"p{identity}", "k", {"n": 1}))
    assert await tables.get("T", f"p{identity}", "k") == row
    blobs = closing(AzureBlobs(endpoint=endpoints["Blob"], container="test"))
    await blobs.put("a", b"content")
    await blobs.append("a", b"!")
    assert await blobs.get("a") == b"content!"
    assert {tuple(request["resource"]) for request in host.requests} == {("https://storage.azure.com",)}
    assert {tuple(request.get("client_id", ())) for request in host.requests} == {(identity,) if identity else ()}


@pytest.mark.usefixtures("host")
async def test_blob_urls_are_signed_with_a_user_delegation_key(
    secure_azurite: str, closing: Closing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Azurite 3.35 issues the key but cannot verify signatures of the current SDK."""
    blobs = closing(AzureBlobs(endpoint=Endpoint(url=endpoint(secure_azurite, "Blob")), container="test"))
    request_key, requests = SasKeys._request, []

    def counted(keys: SasKeys, *arguments: Any) -> Any:
        requests.append(arguments)
        return request_key(keys, *arguments)

    monkeypatch.setattr(SasKeys, "_request", counted)
    upload = await blobs.presign_upload("up", length=3, content_type="image/png", lifetime_s=60)
    download = await blobs.presign_download("up", content_type="image/png", lifetime_s=60)
    for address, right in ((upload.url, "c"), (download, "r")):
        query = {name: values[0] for name, values in parse_qs(urlsplit(address).query).items()}
        assert (query["sp"], query["sr"], query["skoid"], query["sktid"]) == (right, "b", OBJECT_ID, TENANT_ID)
        assert query["skt"] < query["se"] < query["ske"]
        assert query["sig"]
    assert len(requests) == 1
    await blobs.presign_download("up", content_type="image/png", lifetime_s=24 * 3600)
    assert len(requests) == 2


async def test_a_rejected_identity_is_reported_with_the_required_role(
    secure_azurite: str, host: IdentityEndpoint, closing: Closing
) -> None:
    host.lifetime_s = -30
    tables = closing(AzureTables(endpoint=Endpoint(url=endpoint(secure_azurite, "Table")), prefix="test"))
    text = await error_of(lambda: tables.get("T", "p", "k"))
    assert "denied access: " in text
    assert "'Storage Table Data Contributor'" in text


async def test_a_machine_without_identity_is_reported(
    secure_azurite: str, closing: Closing, monkeypatch: pytest.MonkeyPatch, certificate: Path
) -> None:
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
    monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:1/msi/token")
    monkeypatch.setenv("IDENTITY_HEADER", SECRET)
    monkeypatch.setattr(adapter, "MAX_RETRY_PAUSE_S", 0)
    blobs = closing(AzureBlobs(endpoint=Endpoint(url=endpoint(secure_azurite, "Blob")), container="test"))
    text = await error_of(lambda: blobs.get("a"))
    assert "Check " in text
    assert "this machine's managed identity" in text
