"""Certificates of a site: name constraints, renewal and import."""

import datetime as dt
import ipaddress
import itertools
import os
import ssl
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from infra.tls import server_ca
from infra.tls.server_ca import TlsError
from tests.harness.paths import ROOT

NOW = dt.datetime.now(dt.UTC)
END = NOW + dt.timedelta(days=server_ca.SERVER_DAYS)
SITE = server_ca.names(("site.example",), ("192.0.2.1",))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    server_ca.create(tmp_path / "tls", SITE, now=NOW)
    return tmp_path / "tls"


def accepted(ca: Path, certificate: Path, key: Path, name: str) -> bool:
    """Whether a client that trusts ``ca`` accepts the certificate for ``name``."""
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server.load_cert_chain(certificate, key)
    client = ssl.create_default_context(cafile=str(ca))
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    client_side = client.wrap_bio(to_client, to_server, server_hostname=name)
    server_side = server.wrap_bio(to_server, to_client, server_side=True)
    for side in itertools.cycle((client_side, server_side)):
        try:
            side.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError:
            return False
        if side is client_side:
            break
    return True


def test_the_certificate_is_valid_for_the_sites_names_only(home: Path) -> None:
    files = home / "ca.crt", home / "server.crt", home / "server.key"
    assert all(accepted(*files, name) for name in ("site.example", "192.0.2.1", "localhost", "127.0.0.1", "::1"))
    assert not any(accepted(*files, name) for name in ("other.example", "192.0.2.2", "www.site.example.org"))


def test_file_modes_do_not_depend_on_the_umask(tmp_path: Path) -> None:
    previous = os.umask(0o077)
    try:
        server_ca.create(tmp_path / "tls", SITE, now=NOW)
    finally:
        os.umask(previous)
    modes = {path.name: path.stat().st_mode & 0o777 for path in (tmp_path / "tls").iterdir()}
    assert modes == {"ca.key": 0o600, "server.key": 0o600, "ca.crt": 0o644, "server.crt": 0o644}
    assert (tmp_path / "tls").stat().st_mode & 0o777 == 0o700


def test_a_stolen_ca_key_cannot_forge_other_sites(home: Path) -> None:
    ca = server_ca.load(home / "ca.crt")
    signer = load_pem_private_key((home / "ca.key").read_bytes(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    for name in (
        x509.DNSName("site.example"),
        x509.DNSName("bank.example"),
        x509.IPAddress(ipaddress.ip_address("192.0.2.7")),
    ):
        key = ec.generate_private_key(ec.SECP256R1())
        day = dt.timedelta(days=1)
        builder = x509.CertificateBuilder(ca.subject, x509.Name([]), key.public_key(), 1, NOW - day, NOW + day)
        builder = builder.add_extension(x509.SubjectAlternativeName([name]), critical=True)
        forged = builder.sign(signer, hashes.SHA256())
        (home / "forged.crt").write_bytes(server_ca.pem(forged) + server_ca.pem(ca))
        (home / "forged.key").write_bytes(server_ca.key_pem(key))
        forgery = accepted(home / "ca.crt", home / "forged.crt", home / "forged.key", str(name.value))
        assert forgery == (name.value == "site.example")


def test_renewal_keeps_the_names_and_the_ca(home: Path) -> None:
    before = server_ca.load(home / "server.crt")
    ca = (home / "ca.crt").read_bytes()
    server_ca.renew(home, now=NOW + dt.timedelta(days=300))
    after = server_ca.load(home / "server.crt")
    assert after.not_valid_after_utc > before.not_valid_after_utc
    assert (home / "ca.crt").read_bytes() == ca
    assert accepted(home / "ca.crt", home / "server.crt", home / "server.key", "site.example") is False, "not yet valid"
    server_ca.renew(home, now=NOW)
    assert accepted(home / "ca.crt", home / "server.crt", home / "server.key", "site.example")


def test_expiry_is_reported(home: Path) -> None:
    assert "soon" not in server_ca.describe(home, now=NOW)
    late = END - dt.timedelta(days=server_ca.RENEW_DAYS)
    assert "expires soon, renew it" in server_ca.describe(home, now=late)
    with pytest.raises(TlsError, match="expired on"):
        server_ca.describe(home, now=END)


def test_a_second_ca_is_rejected(home: Path) -> None:
    with pytest.raises(TlsError, match="renew with --renew"):
        server_ca.create(home, SITE, now=NOW)


def test_imported_certificates_are_checked(home: Path, tmp_path: Path) -> None:
    server_ca.create(tmp_path / "other", SITE, now=NOW)
    new = tmp_path / "new"
    for key, now, message in (
        (tmp_path / "other" / "server.key", NOW, "is not the key of"),
        (home / "server.key", END, "expired on"),
    ):
        with pytest.raises(TlsError, match=message):
            server_ca.import_certificate(new, certificate=home / "server.crt", key=key, ca=None, now=now)
    server_ca.import_certificate(
        new, certificate=home / "server.crt", key=home / "server.key", ca=home / "ca.crt", now=NOW
    )
    assert accepted(new / "ca.crt", new / "server.crt", new / "server.key", "site.example")
    with pytest.raises(TlsError, match="only certificates of this CA can be renewed"):
        server_ca.renew(new, now=NOW)


@pytest.mark.parametrize("name", ["", "a b", "*.example", "-", "ä.example", "a..b", "x" * 64])
def test_invalid_names_are_rejected(name: str) -> None:
    with pytest.raises(TlsError, match="is not a DNS name"):
        server_ca.names((name,), ())
    with pytest.raises(TlsError, match="give a name with --name"):
        server_ca.names((), ("site.example",))


def test_the_command_creates_certificates_once(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "infra.tls", "--home", str(tmp_path / "tls"), "--name", "site.example"]
    first = subprocess.run([*command, "--address", "192.0.2.1"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert first.stdout.startswith("for localhost, site.example, 127.0.0.1, ::1, 192.0.2.1, until ")
    second = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (second.returncode, second.stderr.count("\n")) == (2, 1)
