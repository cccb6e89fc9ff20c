"""TLS contexts: the certificate authority pinned at enrollment, or those of the operating system."""

import ssl
from pathlib import Path


def context(ca: Path | None) -> ssl.SSLContext:
    """A context that checks certificates and host names; TLS 1.2 or newer.

    Raises:
        OSError: The pinned authority cannot be read.
    """
    try:
        tls_context = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except ssl.SSLError as error:
        raise OSError(f"the pinned authority in {ca} cannot be read: {error}") from error
    tls_context.minimum_version = ssl.TLSVersion.TLSv1_2
    return tls_context


def broker(*, tls: bool, server: str, ca: Path | None, own: tuple[Path, Path] | None) -> ssl.SSLContext | None:
    """The TLS context for the broker that the cloud names; ``None`` for a connection without TLS.

    Args:
        tls: Whether the broker uses TLS, according to the cloud.
        server: URL of the cloud.
        ca: Pinned authority.
        own: Client certificate and key, if the broker requires them.

    Raises:
        ValueError: The broker has no TLS although the cloud has: an attack or a wrong setting would expose credentials.
    """
    if tls:
        tls_context = context(ca)
        if own is not None:
            tls_context.load_cert_chain(*own)
        return tls_context
    if server.startswith("https:"):
        raise ValueError("the server uses TLS, but its broker does not; start the broker with TLS")
    return None
