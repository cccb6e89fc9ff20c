"""Connections beyond this machine use TLS, and only with a server that a trusted certificate names."""

import asyncio
import datetime as dt
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from device_agent.protocol.xmpp import stream as xmpp_stream
from device_agent.protocol.xmpp.stream import Login, Stream, StreamError
from tests.harness.network.brokers import HOST
from tests.harness.network.xmpp import DOMAIN, Prosody, start_prosody

NOWHERE = "http://127.0.0.1:9/verify"


def certificate(folder: Path, name: str) -> tuple[Path, Path]:
    """A certificate that signs itself, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = dt.datetime.now(dt.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=1))
        .not_valid_after(now + dt.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / f"{name}.pem", folder / f"{name}.key"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return paths


@pytest.fixture(params=[DOMAIN])
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Prosody, Path]]:
    """Prosody with a certificate of this name."""
    pem, key = certificate(tmp_path, request.param)
    with start_prosody(tmp_path / "prosody", NOWHERE, more=("--certificate", str(pem), "--key", str(key))) as prosody:
        yield prosody, pem


@pytest.fixture(autouse=True)
def _far_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Login, "local", property(lambda _: False))


def refusal(port: int, trusted: Path | None, monkeypatch: pytest.MonkeyPatch) -> str:
    """Why a login is rejected. No server runs, so a login that reaches the password check is rejected there."""
    if trusted is not None:
        monkeypatch.setattr(ssl, "create_default_context", _trusting(trusted))

    async def login() -> None:
        stream = Stream(Login(HOST, port, f"abc@{DOMAIN}/x", "pw"), message=_nothing, presence=_nothing)
        try:
            await stream.open()
        finally:
            await stream.close()

    with pytest.raises(StreamError) as error:
        asyncio.run(login())
    return str(error.value)


def watched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[bool, str]]:
    """What is sent from now on, and whether under TLS."""
    sent: list[tuple[bool, str]] = []
    was = xmpp_stream._Client.send_raw

    def send_raw(self: Any, data: Any) -> None:
        sent.append((self.transport.get_extra_info("ssl_object") is not None, str(data)))
        was(self, data)

    monkeypatch.setattr(xmpp_stream._Client, "send_raw", send_raw)
    return sent


def test_with_a_trusted_certificate_the_password_is_asked_for_under_tls(
    server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    prosody, pem = server
    sent = watched(monkeypatch)
    assert "rejects the password" in refusal(prosody.port, pem, monkeypatch)
    (auth,) = [secure for secure, data in sent if "<auth" in data]
    assert auth is True


def test_an_untrusted_certificate_is_rejected(server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "certificate" in refusal(server[0].port, None, monkeypatch)


@pytest.mark.parametrize("server", ["another.localhost"], indirect=True)
def test_a_trusted_certificate_of_another_name_is_refused(
    server: tuple[Prosody, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "certificate" in refusal(server[0].port, server[1], monkeypatch)


def test_a_server_without_tls_is_not_told_a_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = watched(monkeypatch)
    with start_prosody(tmp_path / "prosody", NOWHERE) as prosody:
        assert "no TLS" in refusal(prosody.port, None, monkeypatch)
    assert not any("<auth" in data for _, data in sent)


def _trusting(pem: Path) -> Any:
    made = ssl.create_default_context

    def context(*arguments: Any, **options: Any) -> ssl.SSLContext:
        trusting = made(*arguments, **options)
        trusting.load_verify_locations(pem)
        return trusting

    return context


def _nothing(_: Any) -> None:
    """No program listens."""
