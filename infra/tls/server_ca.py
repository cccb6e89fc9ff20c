"""A site's certificate authority and its server certificate.

Name constraints (RFC 5280) limit the CA to the site's own names and addresses, so that a stolen key cannot impersonate
other sites. Keys use P-256, which all browsers and brokers support.
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
"""Browsers reject longer-lived certificates of public CAs."""
RENEW_DAYS = 30
"""A certificate is reported as expiring this long before its end."""
LOOPBACK_NAMES = ("localhost",)
LOOPBACK = ("127.0.0.1", "::1")
_SKEW = dt.timedelta(minutes=5)
"""Tolerance for slow clocks of agents."""

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class TlsError(Exception):
    """A certificate or key cannot be used; the message names it and the remedy."""


@dataclass(frozen=True, slots=True)
class Names:
    """DNS names and addresses of a site."""

    dns: tuple[str, ...]
    addresses: tuple[Address, ...]

    @property
    def alternatives(self) -> list[x509.GeneralName]:
        """The names as a subjectAltName."""
        return [*(x509.DNSName(name) for name in self.dns), *(x509.IPAddress(each) for each in self.addresses)]


def names(dns: tuple[str, ...], addresses: tuple[str, ...]) -> Names:
    """The names of the site and of the machine itself.

    Raises:
        TlsError: An invalid name or address.
    """
    result: list[Address] = []
    for text in dict.fromkeys((*LOOPBACK, *addresses)):
        try:
            result.append(ipaddress.ip_address(text))
        except ValueError as error:
            raise TlsError(f"'{text}' is not an IP address; give a name with --name") from error
    for text in dns:
        labels = text.split(".")
        if not text.isascii() or not all(
            label and len(label) < 64 and label.replace("-", "").isalnum()  # noqa: PLR2004 (RFC 1035)
            for label in labels
        ):
            raise TlsError(f"'{text}' is not a DNS name such as site.example")
    return Names(tuple(dict.fromkeys((*LOOPBACK_NAMES, *dns))), tuple(result))


def create(folder: Path, site: Names, *, now: dt.datetime) -> None:
    """Create a CA and a server certificate in ``folder``.

    Raises:
        TlsError: A CA exists already: agents have pinned it.
        OSError: The folder cannot be written.
    """
    if (folder / CA_KEY).exists() or (folder / CERTIFICATE).exists():
        raise TlsError(f"{folder} has certificates already, which agents have pinned; renew with --renew")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Telescope site {secrets.token_hex(4)}")])
    networks = [ipaddress.ip_network(each) for each in site.addresses]
    permitted = [*(x509.DNSName(name) for name in site.dns), *(x509.IPAddress(each) for each in networks)]
    certificate = (
        builder(subject, subject, key, now, now + dt.timedelta(days=CA_DAYS))
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
    """Issue a new server certificate for the same names by the same CA; agents keep their pinned CA.

    Raises:
        TlsError: The CA's key is not available.
    """
    try:
        authority = load(folder / CA_CERTIFICATE)
        key = serialization.load_pem_private_key((folder / CA_KEY).read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise TlsError(
            f"cannot use the CA in {folder}: {error}; only certificates of this CA can be renewed"
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TlsError(f"{folder / CA_KEY} is not a P-256 key")
    alternatives = load(folder / CERTIFICATE).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    _issue(folder, authority, key, list(alternatives), now)


def import_certificate(folder: Path, *, certificate: Path, key: Path, ca: Path | None, now: dt.datetime) -> None:
    """Install a certificate with its chain, and its CA if that is private.

    Raises:
        TlsError: Certificate and key do not match, or the certificate has expired.
        OSError: A file cannot be read, or the folder cannot be written.
    """
    current = load(certificate)
    try:
        private_key = serialization.load_pem_private_key(key.read_bytes(), None)
    except (ValueError, TypeError) as error:
        raise TlsError(f"{key} is not a private key without a password: {error}") from error
    if _public(private_key.public_key()) != _public(current.public_key()):
        raise TlsError(f"{key} is not the key of {certificate}")
    if now >= current.not_valid_after_utc:
        raise TlsError(f"{certificate} expired on {current.not_valid_after_utc:%Y-%m-%d}")
    if ca is not None:
        load(ca)
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    files.write(folder / KEY, key.read_bytes(), mode=0o600)
    files.write(folder / CERTIFICATE, certificate.read_bytes(), mode=0o644)
    if ca is not None:
        files.write(folder / CA_CERTIFICATE, ca.read_bytes(), mode=0o644)


def describe(folder: Path, *, now: dt.datetime) -> str:
    """Names and expiry of the certificate in one line, with a warning if it expires soon.

    Raises:
        TlsError: It cannot be used.
    """
    current = load(folder / CERTIFICATE)
    try:
        alternatives = current.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound as error:
        raise TlsError(f"{folder / CERTIFICATE} has no subjectAltName") from error
    subjects = ", ".join(str(name.value) for name in alternatives)
    remaining = current.not_valid_after_utc - now
    if remaining <= dt.timedelta():
        raise TlsError(f"{folder / CERTIFICATE} expired on {current.not_valid_after_utc:%Y-%m-%d}; renew it")
    warning = "; it expires soon, renew it" if remaining <= dt.timedelta(days=RENEW_DAYS) else ""
    return f"for {subjects}, until {current.not_valid_after_utc:%Y-%m-%d}{warning}"


def load(path: Path) -> x509.Certificate:
    """The first certificate of a file.

    Raises:
        TlsError: There is none.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except FileNotFoundError as error:
        raise TlsError(f"{path} does not exist; create certificates with `python -m infra.tls --home ...`") from error
    except (OSError, ValueError) as error:
        raise TlsError(f"{path} is not a certificate: {error}") from error


def pem(certificate: x509.Certificate) -> bytes:
    """A certificate in PEM format."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """A private key in PEM format."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, now: dt.datetime, end: dt.datetime
) -> x509.CertificateBuilder:
    """A certificate of a key, valid until ``end``, without extensions."""
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _SKEW)
        .not_valid_after(end)
    )


def usage(*, authority: bool) -> x509.KeyUsage:
    """Key usage extension."""
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
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Telescope")])
    certificate = (
        builder(subject, authority.subject, key, now, end)
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
    assert hasattr(key, "public_bytes")  # noqa: S101 (true for every public key)
    result: bytes = key.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    return result
