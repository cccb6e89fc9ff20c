"""TLS towards the broker."""

import ssl
from pathlib import Path

from function_app.ports.broker_access import BrokerAccessError


def client_context(ca: Path | None, own: Path | None = None) -> ssl.SSLContext:
    """Trusts one authority, or those that the machine trusts; shows ``service.crt`` of the folder ``own``.

    Raises:
        BrokerAccessError: Its certificate cannot be read.
    """
    try:
        context = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except OSError as error:  # SSLError is one
        raise BrokerAccessError(f"the authority in {ca} cannot be read: {error}") from error
    if own is not None:
        try:
            context.load_cert_chain(own / "service.crt", own / "service.key")
        except OSError as error:
            raise BrokerAccessError(f"the functions' own certificate in {own} cannot be read: {error}") from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context
