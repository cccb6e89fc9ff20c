"""The certificates of a site: what its authority may speak for, renewal, and those that come from elsewhere."""

import datetime as dt
import ipaddress
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
SITE = server_ca.names(("site.example",), ("192.0.2.1",))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    server_ca.make(tmp_path / "tls", SITE, now=NOW)
    return tmp_path / "tls"


def accepted(ca: Path, certificate: Path, key: Path, name: str) -> bool:
    """Whether a client that trusts ``ca`` takes a server with this certificate to be ``name``."""
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server.load_cert_chain(certificate, key)
    client = ssl.create_default_context(cafile=str(ca))
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    ours = client.wrap_bio(to_client, to_server, server_hostname=name)
    theirs = server.wrap_bio(to_server, to_client, server_side=True)
    waiting = [ours, theirs]
    for turn in range(20):
        side = waiting[turn % 2]
        try:
            side.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError:
            return False
        if side is ours:
            return True
    raise AssertionError("no end of the handshake")


def test_the_site_is_known_by_all_its_names_and_no_other(home: Path) -> None:
    shown = home / "ca.crt", home / "server.crt", home / "server.key"
    assert all(accepted(*shown, name) for name in ("site.example", "192.0.2.1", "localhost", "127.0.0.1", "::1"))
    assert not any(accepted(*shown, name) for name in ("other.example", "192.0.2.2", "www.site.example.org"))


def test_keys_are_their_owners_alone(home: Path) -> None:
    modes = {path.name: path.stat().st_mode & 0o777 for path in home.iterdir()}
    assert modes == {"ca.key": 0o600, "server.key": 0o600, "ca.crt": 0o644, "server.crt": 0o644}
    assert home.stat().st_mode & 0o777 == 0o700


def test_the_authority_can_pretend_to_be_nobody_else(home: Path) -> None:
    """With its key in hand a certificate for another name can be signed; nobody takes it."""
    ca = server_ca.load(home / "ca.crt")
    signer = load_pem_private_key((home / "ca.key").read_bytes(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    for name in (x509.DNSName("bank.example"), x509.IPAddress(ipaddress.ip_address("192.0.2.7"))):
        key = ec.generate_private_key(ec.SECP256R1())
        forged = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([]))
            .issuer_name(ca.subject)
            .public_key(key.public_key())
            .serial_number(1)
            .not_valid_before(NOW - dt.timedelta(days=1))
            .not_valid_after(NOW + dt.timedelta(days=1))
            .add_extension(x509.SubjectAlternativeName([name]), critical=True)
            .sign(signer, hashes.SHA256())
        )
        (home / "forged.crt").write_bytes(server_ca.pem(forged) + server_ca.pem(ca))
        (home / "forged.key").write_bytes(server_ca.key_pem(key))
        assert not accepted(home / "ca.crt", home / "forged.crt", home / "forged.key", str(name.value))


def test_a_renewed_certificate_is_another_for_the_same_names_by_the_same_authority(home: Path) -> None:
    before = server_ca.load(home / "server.crt")
    ca = (home / "ca.crt").read_bytes()
    server_ca.renew(home, now=NOW + dt.timedelta(days=300))
    after = server_ca.load(home / "server.crt")
    assert after.not_valid_after_utc > before.not_valid_after_utc
    assert (home / "ca.crt").read_bytes() == ca
    assert accepted(home / "ca.crt", home / "server.crt", home / "server.key", "site.example") is False, "not yet valid"
    server_ca.renew(home, now=NOW)
    assert accepted(home / "ca.crt", home / "server.crt", home / "server.key", "site.example")


def test_its_end_is_told_in_time(home: Path) -> None:
    assert "soon" not in server_ca.describe(home, now=NOW)
    late = NOW + dt.timedelta(days=server_ca.SERVER_DAYS - server_ca.RENEW_DAYS)
    assert "ends soon, renew it" in server_ca.describe(home, now=late)
    with pytest.raises(TlsError, match="ended on"):
        server_ca.describe(home, now=NOW + dt.timedelta(days=server_ca.SERVER_DAYS))


def test_no_authority_is_made_over_another(home: Path) -> None:
    with pytest.raises(TlsError, match="renew with --renew"):
        server_ca.make(home, SITE, now=NOW)


def test_certificates_from_elsewhere_are_looked_at_before_they_are_taken(home: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    server_ca.make(other, SITE, now=NOW)
    new = tmp_path / "new"
    with pytest.raises(TlsError, match="is not the key of"):
        server_ca.take(new, certificate=home / "server.crt", key=other / "server.key", ca=None, now=NOW)
    end = NOW + dt.timedelta(days=server_ca.SERVER_DAYS)
    with pytest.raises(TlsError, match="ended on"):
        server_ca.take(new, certificate=home / "server.crt", key=home / "server.key", ca=None, now=end)
    server_ca.take(new, certificate=home / "server.crt", key=home / "server.key", ca=home / "ca.crt", now=NOW)
    assert accepted(new / "ca.crt", new / "server.crt", new / "server.key", "site.example")
    with pytest.raises(TlsError, match="only its own certificates renew"):
        server_ca.renew(new, now=NOW)


@pytest.mark.parametrize("name", ["", "a b", "*.example", "-", "ä.example", "a..b", "x" * 64])
def test_a_wrong_name_is_named(name: str) -> None:
    with pytest.raises(TlsError, match="is no DNS name"):
        server_ca.names((name,), ())


def test_a_name_is_no_address() -> None:
    with pytest.raises(TlsError, match="give a name with --name"):
        server_ca.names((), ("site.example",))


def test_one_command_makes_it_and_says_what_for(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "infra.tls", "--home", str(tmp_path / "tls"), "--name", "site.example"]
    made = subprocess.run([*command, "--address", "192.0.2.1"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert made.stdout.startswith("for localhost, site.example, 127.0.0.1, ::1, 192.0.2.1, until ")
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
