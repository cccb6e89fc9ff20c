"""The console may download recordings from the configured cloud store, and from no other server."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import httpx
import pytest
from azure.storage.blob import BlobServiceClient, CorsRule

from function_app import bootstrap
from function_app.adapters.factory import prepare
from function_app.bootstrap import Functions
from function_app.entrypoints.http.app import create_app
from function_app.ports.blobs import origin_of
from function_app.settings import Settings, read
from tests.harness.stores.aws import use_credentials
from tests.harness.stores.emulators import empty_store, start_emulator

pytestmark = pytest.mark.anyio
CONSOLE = "https://console.example"
NAME = "recordings/anna/a-arm/1/7/0.mcap"


@pytest.fixture(scope="module", params=["azure", "aws"])
def emulator(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    with start_emulator(request.param) as address:
        yield request.param, address


@pytest.fixture
def configuration(emulator: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    use_credentials(monkeypatch)
    kind, address = emulator
    store = empty_store("azure" if kind == "azure" else "aws", address)
    return read({"TELESCOPE_HOME": str(tmp_path), "TELESCOPE_PUBLIC_URL": CONSOLE, **store})


@pytest.fixture
async def functions(configuration: Settings) -> AsyncIterator[Functions]:
    functions = bootstrap.build(configuration)
    yield functions
    await functions.close()


async def test_the_policy_of_the_console_names_the_origin_of_the_store(
    functions: Functions, configuration: Settings
) -> None:
    await prepare(configuration)
    await functions.blobs.put(NAME, b"content")
    origin = origin_of(await functions.blobs.presign_download(NAME, content_type="application/json", lifetime_s=60))
    transport = httpx.ASGITransport(create_app(functions))
    async with httpx.AsyncClient(transport=transport, base_url=CONSOLE) as client:
        policy = (await client.get("/api/docs")).headers["content-security-policy"]
    sources = next(part.split() for part in policy.split(";") if "connect-src" in part)
    assert sources == ["connect-src", "'self'", configuration.websocket_url, origin]
    assert policy.count(origin) == 1


@pytest.mark.parametrize("emulator", ["azure"], indirect=True)
async def test_azure_permits_pages_to_read_a_download_after_the_documented_step(
    functions: Functions, emulator: tuple[str, str]
) -> None:
    with BlobServiceClient.from_connection_string(emulator[1]) as service:
        service.set_service_properties(cors=[CorsRule([CONSOLE], ["GET"])])
    await functions.blobs.put(NAME, b"content")
    url = await functions.blobs.presign_download(NAME, content_type="application/json", lifetime_s=60)
    async with httpx.AsyncClient() as client:
        own, foreign = [
            await client.get(url, headers={"Origin": origin}) for origin in (CONSOLE, "https://other.example")
        ]
    assert (own.content, own.headers["access-control-allow-origin"]) == (b"content", CONSOLE)
    assert "access-control-allow-origin" not in foreign.headers
