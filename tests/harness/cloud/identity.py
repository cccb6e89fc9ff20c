"""A fake identity endpoint of a Functions host, and certificates for servers with TLS."""

import contextlib
import datetime as dt
import ipaddress
import time
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import jwt
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from tests.harness.network.http_server import QuietHandler, running

HOST = "127.0.0.1"
OBJECT_ID = "5a3c8c8e-0e0c-4b43-9d53-0d0f1a6e4c11"
TENANT_ID = "b0e1f7d4-21e8-4a35-8c4e-6a0b7c2d9f10"
SECRET = "the host's own"


def make_certificate(folder: Path, host: str = HOST) -> Path:
    """A self-signed certificate of a host or the loopback address, and its key next to it in ``key.pem``."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, host)])
    alternative = x509.IPAddress(ipaddress.ip_address(HOST)) if host == HOST else x509.DNSName(host)
    now = dt.datetime.now(dt.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([alternative]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    path = folder / "certificate.pem"
    path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return path


class IdentityEndpoint(ThreadingHTTPServer):
    """Issues tokens and records the queries of requests."""

    def __init__(self) -> None:
        super().__init__((HOST, 0), _TokenHandler)
        self.requests: list[dict[str, list[str]]] = []
        self.lifetime_s = 3600


class _TokenHandler(QuietHandler):
    server: IdentityEndpoint

    def handle_any(self) -> None:
        assert self.headers["X-IDENTITY-HEADER"] == SECRET
        query = parse_qs(urlsplit(self.path).query)
        self.server.requests.append(query)
        (audience,) = query["resource"]
        now = int(time.time())
        times = {"iat": now - 60, "nbf": now - 60, "exp": now + self.server.lifetime_s}
        principal = {"oid": OBJECT_ID, "tid": TENANT_ID}
        claims = {"aud": audience, "iss": "https://sts.windows.net/telescope/", **principal, **times}
        token = jwt.encode(claims, "not verified by the server under test", "HS256")
        self.respond_json(
            {"access_token": token, "expires_on": str(now + 3600), "resource": audience, "token_type": "Bearer"}
        )


@contextlib.contextmanager
def start_identity_endpoint(monkeypatch: pytest.MonkeyPatch, certificate: Path) -> Iterator[IdentityEndpoint]:
    """Run an identity endpoint and set the environment variables that name it."""
    endpoint = IdentityEndpoint()
    monkeypatch.setenv("IDENTITY_ENDPOINT", f"http://{HOST}:{endpoint.server_port}/msi/token")
    monkeypatch.setenv("IDENTITY_HEADER", SECRET)
    monkeypatch.setenv("REQUESTS_CA_BUNDLE", str(certificate))
    with running(endpoint):
        yield endpoint
