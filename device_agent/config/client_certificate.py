"""The agent's client certificate, for brokers that require one. Its key never leaves the machine."""

from collections.abc import Callable
from pathlib import Path

from device_agent.config import private_file

_SKEW_MS = 300_000
"""The cloud backdates certificates by this time, for brokers whose clock is slow [ms]."""
_RESOLUTION_MS = 1000
"""Certificates have a resolution of one second [ms]."""
_RENEW_AT_SHARE = 2 / 3
"""Share of the lifetime after which the certificate is renewed."""


class ClientCertificate:
    """Manages ``device.crt`` and ``device.key`` of the agent's folder."""

    def __init__(self, folder: Path) -> None:
        self._certificate = folder / "device.crt"
        self._key = folder / "device.key"

    def ready(self, *, after_ms: float, now_ms: float, request_chain: Callable[[str], str]) -> tuple[Path, Path]:
        """A valid certificate and its key; requests a new one if necessary.

        Args:
            after_ms: Older certificates belong to an earlier pairing and are not valid [ms].
            now_ms: The cloud's time [ms].
            request_chain: Sends a certificate request to the cloud and returns the chain, both PEM.

        Raises:
            ConfigError: The files cannot be written.
            ValueError: The cloud's response is not a certificate for this key.
        """
        if not self._is_valid(after_ms, now_ms):
            self._renew(request_chain)
        return self._certificate, self._key

    def _is_valid(self, after_ms: float, now_ms: float) -> bool:
        from cryptography import x509  # noqa: PLC0415 (only if the broker requires it)

        try:
            certificate = x509.load_pem_x509_certificate(self._certificate.read_bytes())
            matches = _same(certificate, self._key.read_bytes())
        except (OSError, ValueError, TypeError):
            return False
        begin_ms = certificate.not_valid_before_utc.timestamp() * 1000
        end_ms = certificate.not_valid_after_utc.timestamp() * 1000
        newer = begin_ms + _SKEW_MS + _RESOLUTION_MS > after_ms
        return matches and newer and now_ms < begin_ms + _RENEW_AT_SHARE * (end_ms - begin_ms)

    def _renew(self, request_chain: Callable[[str], str]) -> None:
        from cryptography import x509  # noqa: PLC0415
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415

        key = ec.generate_private_key(ec.SECP256R1())
        request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
        chain = request_chain(request.public_bytes(serialization.Encoding.PEM).decode()).encode()
        pem = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        if not _same(x509.load_pem_x509_certificate(chain), pem):
            raise ValueError("the cloud's certificate is for another key")
        # After a crash between both writes the files do not match; `_is_valid` detects this and they are replaced.
        private_file.write(self._key, pem)
        private_file.write(self._certificate, chain)


def _same(certificate: object, key_pem: bytes) -> bool:
    """Whether a certificate belongs to this key."""
    from cryptography import x509  # noqa: PLC0415
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415

    assert isinstance(certificate, x509.Certificate)  # noqa: S101 (x509 is imported late, so the signature cannot name its type)
    key = serialization.load_pem_private_key(key_pem, None)
    form = serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    return key.public_key().public_bytes(*form) == certificate.public_key().public_bytes(*form)
