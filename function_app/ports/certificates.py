"""X.509 certificates for agents, for brokers that require client certificates."""

from typing import NamedTuple, Protocol


class CertificateRefused(Exception):  # noqa: N818 (an answer)
    """The request cannot be signed; the text states the reason."""


class Issued(NamedTuple):
    """A client certificate with its chain (PEM)."""

    chain: str
    expires_ms: int


class Certificates(Protocol):
    """The certificate authority for agents. Broker permissions still decide what a certificate holder may do.

    All calls are idempotent and atomic. If the broker or authority is not reachable, a call raises
    ``BrokerAccessError`` and may be retried.

    Example::

        issued = await certificates.issue(agent.id, csr_pem)
    """

    @property
    def required(self) -> bool:
        """Whether the broker requires a client certificate."""

    async def issue(self, agent: str, request: str) -> Issued:
        """Issue a certificate with the agent's id as common name, regardless of the subject in the request.

        ``request`` is a PKCS #10 request (PEM), signed by its own key.

        Raises:
            CertificateRefused: The request or its signature is not valid, or brokers do not support the key type.
            BrokerAccessError: The certificate cannot be issued or stored.
        """

    async def set_space(self, agent: str, space: str) -> None:
        """Restrict the agent's certificates to one space, where the broker authorizes by certificate alone.

        Raises:
            BrokerAccessError: The state is unknown.
        """

    async def revoke(self, agent: str) -> None:
        """Revoke all certificates of an agent. Idempotent.

        Raises:
            BrokerAccessError: The state is unknown.
        """

    async def close(self) -> None:
        """Close all connections."""
