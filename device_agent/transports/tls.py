"""Whom an agent trusts to be its cloud: one authority that was pinned at enrolment, or those of the machine."""

import ssl
from pathlib import Path


def context(ca: Path | None) -> ssl.SSLContext:
    """Checks certificates and names; speaks TLS 1.2 or newer.

    Raises:
        OSError: The pinned authority cannot be read.
    """
    try:
        made = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except ssl.SSLError as error:
        raise OSError(f"the pinned authority in {ca} cannot be read: {error}") from error
    made.minimum_version = ssl.TLSVersion.TLSv1_2
    return made


def broker(*, tls: bool, server: str, ca: Path | None, own: tuple[Path, Path] | None) -> ssl.SSLContext | None:
    """How to connect to the broker that the cloud names.

    Args:
        tls: Whether it speaks TLS, as the cloud says.
        server: The cloud's own address.
        ca: The pinned authority.
        own: This agent's certificate and key, where the broker wants to see them.

    Raises:
        ValueError: It would be in the clear, though the cloud itself is spoken to by TLS: somebody, or a setting, leads
            credentials out of it.
    """
    if tls:
        made = context(ca)
        if own is not None:
            made.load_cert_chain(*own)
        return made
    if server.startswith("https:"):
        raise ValueError("the server speaks TLS and names a broker that does not; start the broker with TLS too")
    return None
