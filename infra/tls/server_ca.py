"""A site's own certificate authority, and the server certificate that browsers, agents and the functions check.

The authority may speak for the site's own names and addresses and for no others (RFC 5280, name constraints): who
steals its key can pretend to be this site, not a bank. Keys are on P-256, which every browser and broker takes.
"""

import datetime as dt
import ipaddress
import secrets
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from infra import files

CA_CERTIFICATE, CA_KEY = "ca.crt", "ca.key"
CERTIFICATE, KEY = "server.crt", "server.key"
CA_DAYS = 3650
SERVER_DAYS = 397
"""Browsers take no longer-lived ones from public authorities; a renewal is one command."""
RENEW_DAYS = 30
"""So long before its end a certificate is said to end soon."""
LOOPBACK_NAMES = ("localhost",)
LOOPBACK = ("127.0.0.1", "::1")
_SKEW = dt.timedelta(minutes=5)
"""Clocks of agents may be behind."""

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class TlsError(Exception):
    """A certificate or key cannot be used; the text says which and what to do."""


@dataclass(frozen=True, slots=True)
class Names:
    """What a site is called: its DNS names and its addresses."""

    dns: tuple[str, ...]
    addresses: tuple[Address, ...]

    @property
    def alternatives(self) -> list[x509.GeneralName]:
        """As a certificate says them."""
        return [*(x509.DNSName(name) for name in self.dns), *(x509.IPAddress(each) for each in self.addresses)]


def names(dns: tuple[str, ...], addresses: tuple[str, ...]) -> Names:
    """The site's names, and those of the machine itself.

    Raises:
        TlsError: One is no name or address.
    """
    found: list[Address] = []
    for text in dict.fromkeys((*LOOPBACK, *addresses)):
        try:
            found.append(ipaddress.ip_address(text))
        except ValueError as error:
            raise TlsError(f"'{text}' is no address; give a name with --name") from error
    for text in dns:
        labels = text.split(".")
        if not text.isascii() or not all(
            label and len(label) < 64 and label.replace("-", "").isalnum()  # noqa: PLR2004 (RFC 1035)
            for label in labels
        ):
            raise TlsError(f"'{text}' is no DNS name, such as site.example")
    return Names(tuple(dict.fromkeys((*LOOPBACK_NAMES, *dns))), tuple(found))


def make(folder: Path, site: Names, *, now: dt.datetime) -> None:
    """An authority and a server certificate in ``folder``.

    Raises:
        TlsError: There is an authority already: agents have pinned it.
        OSError: The folder cannot be written.
    """
    if (folder / CA_KEY).exists() or (folder / CERTIFICATE).exists():
        raise TlsError(f"{folder} has certificates already, which agents have pinned; renew with --renew")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Telescope site {secrets.token_hex(4)}")])
    networks = [ipaddress.ip_network(each) for each in site.addresses]
    permitted = [*(x509.DNSName(name) for name in site.dns), *(x509.IPAddress(each) for each in networks)]
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(now + dt.timedelta(days=CA_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage(authority=True), critical=True)
        .add_extension(x509.NameConstraints(permitted_subtrees=permitted, excluded_subtrees=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    files.write(folder / CA_KEY, key_pem(key), mode=0o600)
    files.write(folder / CA_CERTIFICATE, pem(certificate), mode=0o644)
    _issue(folder, certificate, key, site.alternatives, now)


def renew(folder: Path, *, now: dt.datetime) -> None:
    """A new server certificate for the same names, from the same authority: nobody has to pin anything anew.

    Raises:
        TlsError: The authority's key is not here.
    """
    try:
        authority = load(folder / CA_CERTIFICATE)
        key = serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise TlsError(f"the authority in {folder} cannot be used: {error}; only its own certificates renew") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TlsError(f"{folder / CA_KEY} is no key of ours")
    former = load(folder / CERTIFICATE).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    _issue(folder, authority, key, list(former), now)


def take(folder: Path, *, certificate: Path, key: Path, ca: Path | None, now: dt.datetime) -> None:
    """Use certificates from elsewhere: with the whole chain, and the authority's where it is a private one.

    Raises:
        TlsError: They do not belong together, or are over.
        OSError: One cannot be read, or the folder not written.
    """
    own = load(certificate)
    try:
        private = serialization.load_pem_private_key(key.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise TlsError(f"{key} cannot be read as a private key without a password: {error}") from error
    if _public(private.public_key()) != _public(own.public_key()):
        raise TlsError(f"{key} is not the key of {certificate}")
    if now >= own.not_valid_after_utc:
        raise TlsError(f"{certificate} ended on {own.not_valid_after_utc:%Y-%m-%d}")
    if ca is not None:
        load(ca)
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    files.write(folder / KEY, key.read_bytes(), mode=0o600)
    files.write(folder / CERTIFICATE, certificate.read_bytes(), mode=0o644)
    if ca is not None:
        files.write(folder / CA_CERTIFICATE, ca.read_bytes(), mode=0o644)


def describe(folder: Path, *, now: dt.datetime) -> str:
    """What the certificate is for and how long, in a line; a warning where it ends soon.

    Raises:
        TlsError: It cannot be used.
    """
    own = load(folder / CERTIFICATE)
    try:
        said = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound as error:
        raise TlsError(f"{folder / CERTIFICATE} names no site (no subjectAltName)") from error
    shown = ", ".join(str(each.value) for each in said)
    left = own.not_valid_after_utc - now
    if left <= dt.timedelta():
        raise TlsError(f"{folder / CERTIFICATE} ended on {own.not_valid_after_utc:%Y-%m-%d}; renew it")
    soon = "; it ends soon, renew it" if left <= dt.timedelta(days=RENEW_DAYS) else ""
    return f"for {shown}, until {own.not_valid_after_utc:%Y-%m-%d}{soon}"


def load(path: Path) -> x509.Certificate:
    """The first certificate of a file.

    Raises:
        TlsError: There is none.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except FileNotFoundError as error:
        raise TlsError(f"{path} is not there; make certificates with `python -m infra.tls --home ...`") from error
    except (OSError, ValueError) as error:
        raise TlsError(f"{path} cannot be read as a certificate: {error}") from error


def pem(certificate: x509.Certificate) -> bytes:
    """A certificate as text."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """A private key as text."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def usage(*, authority: bool) -> x509.KeyUsage:
    """What a key may be used for."""
    return x509.KeyUsage(
        digital_signature=not authority,
        key_cert_sign=authority,
        crl_sign=authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _issue(
    folder: Path,
    authority: x509.Certificate,
    signer: ec.EllipticCurvePrivateKey,
    alternatives: list[x509.GeneralName],
    now: dt.datetime,
) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    end = min(now + dt.timedelta(days=SERVER_DAYS), authority.not_valid_after_utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Telescope")]))
        .issuer_name(authority.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(end)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage(authority=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(signer, hashes.SHA256())
    )
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise TlsError(f"{folder / CA_KEY} is not the key of {folder / CA_CERTIFICATE}") from error
    files.write(folder / KEY, key_pem(key), mode=0o600)
    files.write(folder / CERTIFICATE, pem(certificate) + pem(authority), mode=0o644)


def _public(key: object) -> bytes:
    assert hasattr(key, "public_bytes")  # noqa: S101 (every public key has)
    found: bytes = key.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    return found
