"""What every authority for agents looks at before it signs."""

from typing import TYPE_CHECKING

from function_app.ports.certificates import CertificateRefused

if TYPE_CHECKING:
    from cryptography.x509 import CertificateSigningRequest

MAX_REQUEST = 4096
"""Characters; a request for a key on P-256 has 400."""


def read(text: str) -> "CertificateSigningRequest":
    """A request for a key on P-256, which all brokers take, signed by that key.

    Raises:
        CertificateRefused: It is not one.
    """
    from cryptography import x509  # noqa: PLC0415 (only where certificates are in use)
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415

    if len(text) > MAX_REQUEST:
        raise CertificateRefused(f"a request has at most {MAX_REQUEST} characters")
    try:
        request = x509.load_pem_x509_csr(text.encode())
        key = request.public_key()
        good = request.is_signature_valid
    except ValueError as error:
        raise CertificateRefused("not a certificate request (PKCS 10, PEM)") from error
    if not good:
        raise CertificateRefused("the request is not signed by the key that it is for")
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise CertificateRefused("the key must be one on P-256")
    return request
