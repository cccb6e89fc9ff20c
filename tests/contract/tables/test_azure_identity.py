"""The functions show their managed identity as a Functions host gives it: Azurite over TLS takes its tokens."""

import datetime as dt
import ipaddress
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import jwt
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from function_app.adapters.azure import blobs as adapter
from function_app.adapters.azure.blobs import AzureBlobs
from function_app.adapters.azure.client import Place
from function_app.adapters.azure.tables import AzureTables
from function_app.ports.tables import Row, StoreError
from tests.support.azure import endpoint, start_azurite

HOST = "127.0.0.1"
SECRET = "the host's own"
CLIENT_ID = "11059fcc-5514-4800-b5f8-49808b9cfab6"

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificate and key of the loopback address, each in a file."""
    folder = tmp_path_factory.mktemp("tls")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, HOST)])
    now = dt.datetime.now(dt.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(HOST))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    path = folder / "certificate.pem"
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM))
    return path


@pytest.fixture(scope="module")
def connection(certificate: Path) -> Iterator[str]:
    options = ("--oauth", "basic", "--cert", str(certificate), "--key", str(certificate.with_name("key.pem")))
    with start_azurite(*options) as connection:
        yield connection


class Host(ThreadingHTTPServer):
    """A Functions host's identity endpoint."""

    def __init__(self) -> None:
        super().__init__((HOST, 0), _Answer)
        self.asked: list[dict[str, list[str]]] = []
        self.lifetime_s = 3600


class _Answer(BaseHTTPRequestHandler):
    server: Host

    def do_GET(self) -> None:
        assert self.headers["X-IDENTITY-HEADER"] == SECRET
        asked = parse_qs(urlsplit(self.path).query)
        self.server.asked.append(asked)
        (audience,) = asked["resource"]
        now = int(time.time())
        times = {"iat": now - 60, "nbf": now - 60, "exp": now + self.server.lifetime_s}
        claims = {"aud": audience, "iss": "https://sts.windows.net/telescope/", **times}
        token = jwt.encode(claims, "nobody checks it here, all the same", "HS256")
        answer = {"access_token": token, "expires_on": str(now + 3600), "resource": audience, "token_type": "Bearer"}
        body = json.dumps(answer).encode()
        self.send_response_only(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[Host]:
    host = Host()
    thread = threading.Thread(target=host.serve_forever, args=(0.02,))
    thread.start()
    monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:{host.server_port}/msi/token")
    monkeypatch.setenv("IDENTITY_HEADER", SECRET)
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
    yield host
    host.shutdown()
    thread.join()
    host.server_close()


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
