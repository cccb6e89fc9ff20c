"""Validation of certificate signing requests of agents."""

from typing import TYPE_CHECKING

from function_app.ports.certificates import CertificateRefused

if TYPE_CHECKING:
    from cryptography.x509 import CertificateSigningRequest

MAX_REQUEST = 4096
"""Maximum length in characters; a request for a P-256 key has 400."""


def read(text: str) -> "CertificateSigningRequest":
    """Parse a request for a P-256 key, which all brokers support, and verify its signature.

    Raises:
        CertificateRefused: The request is not valid.
    """
    from cryptography import x509  # noqa: PLC0415 (only where certificates are in use)
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415

    if len(text) > MAX_REQUEST:
        raise CertificateRefused(f"a request has at most {MAX_REQUEST} characters")
    try:
        request = x509.load_pem_x509_csr(text.encode())
        key = request.public_key()
        is_signed = request.is_signature_valid
    except ValueError as error:
        raise CertificateRefused("not a certificate request (PKCS 10, PEM)") from error
    if not is_signed:
        raise CertificateRefused("the request is not signed by its own key")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise CertificateRefused("the key is not a P-256 key")
    return request
