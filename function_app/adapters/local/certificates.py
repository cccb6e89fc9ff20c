"""The certificate authority for agents of a site, in files that ``python -m infra.tls --devices`` creates.

The files are ``devices-ca.crt`` and ``devices-ca.key``, the revocation list ``devices.crl``, and ``devices.json`` with
the issued certificates. Mosquitto reads the CA certificate and the revocation list.
"""

import asyncio
import contextlib
import datetime as dt
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from function_app.adapters.local import atomic_files
from function_app.adapters.shared import csr
from function_app.ports.broker_access import BrokerAccessError
from function_app.ports.certificates import Issued

CA_CERTIFICATE, CA_KEY, REVOKED, LEDGER = "devices-ca.crt", "devices-ca.key", "devices.crl", "devices.json"
_LOCK = "devices.lock"
DAYS = 397
_SKEW = dt.timedelta(minutes=5)
"""Maximum lag of the broker's clock."""


class NoCertificates:
    """``Certificates`` for a broker without client certificates."""

    required = False

    async def issue(self, agent: str, request: str) -> Issued:
        """Always raises."""
        del agent, request
        raise BrokerAccessError("the broker requires no client certificates")

    async def set_space(self, agent: str, space: str) -> None:
        """Does nothing."""

    async def revoke(self, agent: str) -> None:
        """Does nothing."""

    async def close(self) -> None:
        """Does nothing."""


class FileCertificates:
    """``Certificates`` in ``folder``. A lock serializes changes of several processes."""

    required = True

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    async def issue(self, agent: str, request: str) -> Issued:
        return await asyncio.to_thread(self._issue, agent, request)

    async def set_space(self, agent: str, space: str) -> None:
        """Does nothing: the roles in mosquitto contain the space."""

    async def revoke(self, agent: str) -> None:
        await asyncio.to_thread(self._revoke, agent)

    async def close(self) -> None:
        """Does nothing."""

    def _issue(self, agent: str, text: str) -> Issued:
        from cryptography import x509  # noqa: PLC0415 (only where certificates are in use)
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID  # noqa: PLC0415

        request = csr.read(text)
        with self._ledger() as ledger:
            authority, signer = self._authority()
            now = dt.datetime.now(dt.UTC)
            end = min(now + dt.timedelta(days=DAYS), authority.not_valid_after_utc)
            serial = x509.random_serial_number()
            ledger.setdefault(agent, []).append({"serial": str(serial), "revoked_at": None})
            certificate = (
                x509.CertificateBuilder()
                .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, agent)]))
                .issuer_name(authority.subject)
                .public_key(request.public_key())
                .serial_number(serial)
                .not_valid_before(now - _SKEW)
                .not_valid_after(end)
                .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
                .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=True)
                .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
                .sign(signer, hashes.SHA256())
            )
        chain = certificate.public_bytes(serialization.Encoding.PEM).decode()
        return Issued(chain, int(end.timestamp() * 1000))

    def _revoke(self, agent: str) -> None:
        from cryptography import x509  # noqa: PLC0415
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415

        with self._ledger() as ledger:
            now = dt.datetime.now(dt.UTC)
            for entry in ledger.get(agent, []):
                entry["revoked_at"] = entry["revoked_at"] or now.isoformat()
            authority, signer = self._authority()
            revocations = (
                x509.CertificateRevocationListBuilder()
                .issuer_name(authority.subject)
                .last_update(now)
                .next_update(authority.not_valid_after_utc)  # an expired list would reject every client
            )
            for entry in (entry for entries in ledger.values() for entry in entries if entry["revoked_at"]):
                revocations = revocations.add_revoked_certificate(
                    x509.RevokedCertificateBuilder()
                    .serial_number(int(entry["serial"]))
                    .revocation_date(dt.datetime.fromisoformat(entry["revoked_at"]))
                    .build()
                )
            content = revocations.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
            atomic_files.write(self._folder / REVOKED, content, mode=0o644)

    def _authority(self) -> tuple[Any, Any]:
        from cryptography import x509  # noqa: PLC0415
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415

        certificate = x509.load_pem_x509_certificate((self._folder / CA_CERTIFICATE).read_bytes())
        key = serialization.load_pem_private_key((self._folder / CA_KEY).read_bytes(), None)
        return certificate, key

    @contextlib.contextmanager
    def _ledger(self) -> Iterator[dict[str, list[dict[str, Any]]]]:
        """The issued certificates by agent, under a lock. Stores them at the end of the ``with`` block."""
        import sqlite3  # noqa: PLC0415 (only where something is written)

        try:
            with contextlib.closing(sqlite3.connect(self._folder / _LOCK, timeout=10, isolation_level=None)) as lock:
                lock.execute("BEGIN EXCLUSIVE")
                path = self._folder / LEDGER
                ledger: dict[str, list[dict[str, Any]]] = json.loads(path.read_bytes()) if path.exists() else {}
                yield ledger
                atomic_files.write(path, json.dumps(ledger, indent=1).encode(), mode=0o600)
        except (OSError, ValueError, sqlite3.Error) as error:
            raise BrokerAccessError(
                f"the authority for agents in {self._folder} cannot be used: {error}; "
                "`python -m infra.tls --devices` creates one"
            ) from error
