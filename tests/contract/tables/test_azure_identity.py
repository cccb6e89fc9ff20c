"""The functions show their managed identity as a Functions host gives it: Azurite over TLS takes its tokens."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from function_app.adapters.azure import blobs as adapter
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import Place
from function_app.adapters.azure.sas_keys import SigningKeys
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import Row, StoreError
from tests.harness.cloud.identity import HOST, OBJECT_ID, SECRET, TENANT_ID, Host, make_certificate, start_host
from tests.harness.stores.azure import endpoint, start_azurite

CLIENT_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificate(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="module")
def connection(certificate: Path) -> Iterator[str]:
    options = ("--oauth", "basic", "--cert", str(certificate), "--key", str(certificate.with_name("key.pem")))
    with start_azurite(*options) as connection:
        yield connection


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[Host]:
    with start_host(monkeypatch, certificate) as host:
        yield host


@pytest.mark.parametrize("identity", ["", CLIENT_ID], ids=["the host's", "another"])
async def test_tables_and_blobs_are_used_with_the_hosts_identity(connection: str, host: Host, identity: str) -> None:
    tables = AzureTables(place=Place(url=endpoint(connection, "Table"), identity=identity), prefix="test")
    blobs = AzureBlobs(place=Place(url=endpoint(connection, "Blob"), identity=identity), container="test")
    row = await tables.create("T", Row(f"p{identity}", "k", {"n": 1}))
    assert await tables.get("T", f"p{identity}", "k") == row
    await blobs.put("a", b"content")
    await blobs.append("a", b"!")
    assert await blobs.get("a") == b"content!"
    await tables.close()
    await blobs.close()
    assert {tuple(asked["resource"]) for asked in host.asked} == {("https://storage.azure.com",)}
    assert {tuple(asked.get("client_id", ())) for asked in host.asked} == {(identity,) if identity else ()}


async def test_addresses_of_blobs_are_signed_with_a_key_that_is_lent_to_the_identity(
    connection: str, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Azurite lends the key; what the SDK of today signs with one, Azurite 3.35 is too old to check."""
    assert host
    blobs = AzureBlobs(place=Place(url=endpoint(connection, "Blob")), container="test")
    borrowed = 0
    borrow = SigningKeys._borrow

    def counted(keys: SigningKeys, *arguments: Any) -> Any:
        nonlocal borrowed
        borrowed += 1
        return borrow(keys, *arguments)

    monkeypatch.setattr(SigningKeys, "_borrow", counted)
    upload = await blobs.presign_upload("up", length=3, content_type="image/png", lifetime_s=60)
    download = await blobs.presign_download("up", content_type="image/png", lifetime_s=60)
    for address, right in ((upload.url, "c"), (download, "r")):
        said = {name: values[0] for name, values in parse_qs(urlsplit(address).query).items()}
        assert (said["sp"], said["sr"], said["skoid"], said["sktid"]) == (right, "b", OBJECT_ID, TENANT_ID)
        assert said["skt"] < said["se"] < said["ske"]
        assert said["sig"]
    assert borrowed == 1
    await blobs.presign_download("up", content_type="image/png", lifetime_s=24 * 3600)
    assert borrowed == 2
    await blobs.close()


async def test_an_identity_that_azure_does_not_take_is_said_with_the_role_it_needs(connection: str, host: Host) -> None:
    host.lifetime_s = -30
    tables = AzureTables(place=Place(url=endpoint(connection, "Table")), prefix="test")
    with pytest.raises(StoreError, match=r"may not be used: .*'Storage Table Data Contributor'") as caught:
        await tables.get("T", "p", "k")
    assert "\n" not in str(caught.value)
    await tables.close()


async def test_a_machine_without_an_identity_is_said_to_have_none(
    connection: str, monkeypatch: pytest.MonkeyPatch, certificate: Path
) -> None:
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
    monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:1/msi/token")
    monkeypatch.setenv("IDENTITY_HEADER", SECRET)
    monkeypatch.setattr(adapter, "RETRY_WITHIN_S", 0)
    blobs = AzureBlobs(place=Place(url=endpoint(connection, "Blob")), container="test")
    with pytest.raises(StoreError, match=r"Check .*this machine's managed identity") as caught:
        await blobs.get("a")
    assert "\n" not in str(caught.value)
    await blobs.close()
