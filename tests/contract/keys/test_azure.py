"""Signing keys in Azure's Key Vault. There is no emulator: what answers here is a fake, as the API's documents have it.

The SDK, its challenges, TLS and the managed identity are real.
"""

import json
import ssl
import threading
from collections.abc import AsyncIterator, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from function_app.adapters.azure.client import Place
from function_app.adapters.azure.signing_keys import KeyVaultKeys
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError
from tests.contract.keys.suite import Again, KeysSuite, Time
from tests.harness.cloud.identity import HOST, make_certificate, start_host

LOOK_MS = 100


class FakeVault(ThreadingHTTPServer):
    """Secrets by name, each a list of versions."""

    def __init__(self, certificate: Path) -> None:
        super().__init__((HOST, 0), _Answer)
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(certificate, certificate.with_name("key.pem"))
        self.socket = context.wrap_socket(self.socket, server_side=True)
        self.secrets: dict[str, list[str]] = {}

    @property
    def url(self) -> str:
        return f"https://{HOST}:{self.server_port}"


class _Answer(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FakeVault

    def do_GET(self) -> None:
        if self._challenged():
            return
        versions = self.server.secrets.get(self._name, [])
        if not versions:
            self._say(404, {"error": {"code": "SecretNotFound", "message": "A secret was not found in this key vault"}})
            return
        self._show(versions)

    def do_PUT(self) -> None:
        sent = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self._challenged():
            return
        versions = self.server.secrets.setdefault(self._name, [])
        versions.append(json.loads(sent)["value"])
        self._show(versions)

    @property
    def _name(self) -> str:
        return urlsplit(self.path).path.split("/")[2]

    def _challenged(self) -> bool:
        if self.headers.get("Authorization"):
            return False
        # The SDK sends no token to a vault whose address does not end with the name that its challenge gives.
        resource = f"https://{HOST.partition('.')[2]}:{self.server.server_port}"
        self.send_response_only(401)
        self.send_header(
            "WWW-Authenticate", f'Bearer authorization="https://login.example/tenant", resource="{resource}"'
        )
        self.send_header("Content-Length", "0")
        self.end_headers()
        return True

    def _show(self, versions: list[str]) -> None:
        where = f"{self.server.url}/secrets/{self._name}/{len(versions):032x}"
        self._say(200, {"value": versions[-1], "id": where, "attributes": {"enabled": True}})

    def _say(self, status: int, body: object) -> None:
        content = json.dumps(body).encode()
        self.send_response_only(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def vault(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeVault]:
    certificate = make_certificate(tmp_path_factory.mktemp("tls"))
    vault = FakeVault(certificate)
    thread = threading.Thread(target=vault.serve_forever, args=(0.02,))
    thread.start()
    with pytest.MonkeyPatch.context() as environment, start_host(environment, certificate):
        yield vault
    vault.shutdown()
    thread.join()
    vault.server_close()


@pytest.fixture
async def again(vault: FakeVault, time: Time) -> AsyncIterator[Again]:
    opened: list[KeyVaultKeys] = []

    async def open_() -> SigningKeys:
        place = Place(url=vault.url)
        opened.append(
            KeyVaultKeys(secret="telescope-keys", place=place, now_ms=time.now_ms, look_every_ms=LOOK_MS, again_ms=0)
        )
        return opened[-1]

    yield open_
    for each in opened:
        await each.close()


@pytest.fixture
async def keys(vault: FakeVault, again: Again) -> SigningKeys:
    vault.secrets.clear()
    keys = await again()
    assert isinstance(keys, KeyVaultKeys)
    await keys.prepare()
    await keys.prepare()
    assert len(vault.secrets["telescope-keys"]) == 1
    return keys


class TestKeyVaultKeys(KeysSuite):
    def wait_for_followers(self, time: Time) -> None:
        time.ms += LOOK_MS


@pytest.mark.anyio
async def test_without_the_secret_it_says_what_to_do(vault: FakeVault, again: Again) -> None:
    vault.secrets.clear()
    with pytest.raises(StoreError, match=r"does not exist.*function_app prepare"):
        await (await again()).current()


@pytest.mark.anyio
async def test_a_secret_that_is_no_ring_is_said(vault: FakeVault, again: Again) -> None:
    vault.secrets["telescope-keys"] = ["no ring"]
    with pytest.raises(StoreError, match="holds no signing keys"):
        await (await again()).current()


@pytest.mark.usefixtures("vault")
@pytest.mark.anyio
async def test_a_vault_that_is_not_there_is_said() -> None:
    keys = KeyVaultKeys(secret="telescope-keys", place=Place(url="https://127.0.0.1:9"))
    with pytest.raises(StoreError, match="TELESCOPE_KEYVAULT_URL"):
        await keys.current()
    await keys.close()
