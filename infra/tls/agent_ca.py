"""A CA for agents, whose client certificates mosquitto requires before any MQTT traffic.

It is separate from the site's server CA: it only signs client certificates, and its key is available to the functions.
"""

import datetime as dt
import secrets
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from infra import files
from infra.tls import server_ca
from infra.tls.server_ca import TlsError

CA_CERTIFICATE, CA_KEY, REVOKED = "devices-ca.crt", "devices-ca.key", "devices.crl"
SERVICE_CERTIFICATE, SERVICE_KEY = "service.crt", "service.key"
"""The functions' own client certificate."""


def create(folder: Path, *, now: dt.datetime) -> None:
    """Create the CA, an empty revocation list, and the functions' client certificate.

    Raises:
        TlsError: A CA exists already.
        OSError: The folder cannot be written.
    """
    if (folder / CA_KEY).exists():
        raise TlsError(f"{folder} has a CA for agents already")
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"Telescope agents {secrets.token_hex(4)}")])
    end = now + dt.timedelta(days=server_ca.CA_DAYS)
    ca_certificate = (
        server_ca.builder(name, name, key, now, end)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(server_ca.usage(authority=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    service_key = ec.generate_private_key(ec.SECP256R1())
    service = (
        server_ca.builder(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "service")]), name, service_key, now, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=True)
        .sign(key, hashes.SHA256())
    )
    revocation_list = x509.CertificateRevocationListBuilder().issuer_name(name).last_update(now).next_update(end)
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    files.write(folder / CA_KEY, server_ca.key_pem(key), mode=0o600)
    files.write(folder / SERVICE_KEY, server_ca.key_pem(service_key), mode=0o600)
    files.write(folder / SERVICE_CERTIFICATE, server_ca.pem(service), mode=0o644)
    crl = revocation_list.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    files.write(folder / REVOKED, crl, mode=0o644)
    files.write(folder / CA_CERTIFICATE, server_ca.pem(ca_certificate), mode=0o644)
