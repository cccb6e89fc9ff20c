"""Signing keys in Azure Key Vault. No emulator exists; a fake implements the documented API.

The SDK, its challenges, TLS and the managed identity are real.
"""

import json
import ssl
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from function_app.adapters.azure.client import Endpoint
from function_app.adapters.azure.signing_keys import KeyVaultKeys
from function_app.ports.tables import StoreError
from tests.contract.conftest import Closing
from tests.contract.keys.suite import Again, Time
from tests.contract.keys.vault_suite import SECRET, Erase, VaultSuite
from tests.harness.cloud.identity import HOST, make_certificate, start_identity_endpoint
from tests.harness.network.http_server import QuietHandler, running


class FakeVault(ThreadingHTTPServer):
    """Secrets by name, each a list of versions."""

    def __init__(self, certificate: Path) -> None:
        super().__init__((HOST, 0), _Secrets)
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.load_cert_chain(certificate, certificate.with_name("key.pem"))
        self.socket = context.wrap_socket(self.socket, server_side=True)
        self.secrets: dict[str, list[str]] = {}

    @property
    def url(self) -> str:
        return f"https://{HOST}:{self.server_port}"


class _Secrets(QuietHandler):
    protocol_version = "HTTP/1.1"
    server: FakeVault

    def handle_any(self) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        name = urlsplit(self.path).path.split("/")[2]
        if not self.headers.get("Authorization"):
            # The SDK sends no token if the vault's address does not end with the domain in the challenge.
            resource = f"https://{HOST.partition('.')[2]}:{self.server.server_port}"
            challenge = f'Bearer authorization="https://login.example/tenant", resource="{resource}"'
            self.respond(401, [("WWW-Authenticate", challenge)], b"")
            return
        if self.command == "PUT":
            self.server.secrets.setdefault(name, []).append(json.loads(content)["value"])
        versions = self.server.secrets.get(name)
        if not versions:
            error = {"code": "SecretNotFound", "message": "A secret was not found in this key vault"}
            self.respond_json({"error": error}, 404)
            return
        version = f"{self.server.url}/secrets/{name}/{len(versions):032x}"
        self.respond_json({"value": versions[-1], "id": version, "attributes": {"enabled": True}})


@pytest.fixture(scope="module")
def vault(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeVault]:
    certificate = make_certificate(tmp_path_factory.mktemp("tls"))
    vault = FakeVault(certificate)
    with running(vault), pytest.MonkeyPatch.context() as environment, start_identity_endpoint(environment, certificate):
        yield vault


class TestKeyVaultKeys(VaultSuite):
    @pytest.fixture
    def erase(self, vault: FakeVault) -> Erase:
        return vault.secrets.clear

    @pytest.fixture
    def again(self, vault: FakeVault, time: Time, closing: Closing) -> Again:
        return lambda: closing(KeyVaultKeys(secret=SECRET, endpoint=Endpoint(url=vault.url), now_ms=time.now_ms))

    @pytest.mark.usefixtures("keys")
    async def test_preparing_again_keeps_the_secret(self, vault: FakeVault) -> None:
        assert len(vault.secrets[SECRET]) == 1

    async def test_a_secret_without_keys_is_reported(self, vault: FakeVault, again: Again) -> None:
        vault.secrets[SECRET] = ["no ring"]
        with pytest.raises(StoreError, match="contains no valid signing keys"):
            await again().current()

    @pytest.mark.usefixtures("vault")
    async def test_an_unreachable_vault_is_reported(self, closing: Closing) -> None:
        keys = closing(KeyVaultKeys(secret=SECRET, endpoint=Endpoint(url="https://127.0.0.1:9")))
        with pytest.raises(StoreError, match="TELESCOPE_KEYVAULT_URL"):
            await keys.current()
