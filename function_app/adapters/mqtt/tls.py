"""TLS context of broker connections."""

import ssl
from pathlib import Path

from function_app.ports.broker_access import BrokerAccessError


def client_context(ca: Path | None, service_folder: Path | None = None) -> ssl.SSLContext:
    """A context that trusts ``ca`` (``None``: the system's CAs) and uses the certificate in ``service_folder``.

    Raises:
        BrokerAccessError: A certificate cannot be read.
    """
    try:
        context = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except OSError as error:  # SSLError is one
        raise BrokerAccessError(f"the authority in {ca} cannot be read: {error}") from error
    if service_folder is not None:
        try:
            context.load_cert_chain(service_folder / "service.crt", service_folder / "service.key")
        except OSError as error:
            raise BrokerAccessError(
                f"the functions' certificate in {service_folder} cannot be read: {error}"
            ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context
