"""The agent's own certificate, where its broker wants to see one: by a key that never leaves this machine."""

from collections.abc import Callable
from pathlib import Path

from device_agent.config import private_file

_SKEW_MS = 300_000
"""The cloud dates a certificate so much before its making, for brokers whose clock is behind."""
_ROUNDED_MS = 1000
"""Its dates are whole seconds."""
_RENEW_AT = 2 / 3
"""After this share of its life another is asked for."""


class OwnCertificate:
    """``device.crt`` and ``device.key`` of the agent's folder.

    Args:
        folder: The agent's own.
    """

    def __init__(self, folder: Path) -> None:
        self._certificate = folder / "device.crt"
        self._key = folder / "device.key"

    def ready(self, *, after_ms: float, now_ms: float, ask: Callable[[str], str]) -> tuple[Path, Path]:
        """A certificate that counts, and its key; asked for where there is none.

        Args:
            after_ms: Older ones were for another pairing, and count no more [ms].
            now_ms: The cloud's time [ms].
            ask: Has the cloud sign a request; both are PEM.

        Raises:
            ConfigError: It cannot be written.
            ValueError: What the cloud gave is no certificate for this key.
        """
        if not self._good(after_ms, now_ms):
            self._renew(ask)
        return self._certificate, self._key

    def _good(self, after_ms: float, now_ms: float) -> bool:
        from cryptography import x509  # noqa: PLC0415 (only where the broker wants it)

        try:
            known = x509.load_pem_x509_certificate(self._certificate.read_bytes())
            fits = _same(known, self._key.read_bytes())
        except (OSError, ValueError, TypeError):
            return False
        begin_ms = known.not_valid_before_utc.timestamp() * 1000
        end_ms = known.not_valid_after_utc.timestamp() * 1000
        newer = begin_ms + _SKEW_MS + _ROUNDED_MS > after_ms
        return fits and newer and now_ms < begin_ms + _RENEW_AT * (end_ms - begin_ms)

    def _renew(self, ask: Callable[[str], str]) -> None:
        from cryptography import x509  # noqa: PLC0415
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415

        key = ec.generate_private_key(ec.SECP256R1())
        request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
        chain = ask(request.public_bytes(serialization.Encoding.PEM).decode()).encode()
        pem = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        if not _same(x509.load_pem_x509_certificate(chain), pem):
            raise ValueError("the cloud gave a certificate for another key")
        # Killed in between the two do not fit, which is seen, and others are made.
        private_file.write(self._key, pem)
        private_file.write(self._certificate, chain)


def _same(certificate: object, key_pem: bytes) -> bool:
    """Whether a certificate is for this key."""
    from cryptography import x509  # noqa: PLC0415
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415

    assert isinstance(certificate, x509.Certificate)  # noqa: S101 (imported late, so its type is not in the signature)
    key = serialization.load_pem_private_key(key_pem, None)
    form = serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    return key.public_key().public_bytes(*form) == certificate.public_key().public_bytes(*form)
