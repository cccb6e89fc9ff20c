"""X.509 for agents, where the broker wants to see a certificate before it hears a word."""

from typing import NamedTuple, Protocol


class CertificateRefused(Exception):  # noqa: N818 (an answer)
    """The request cannot be signed; the text says why."""


class Issued(NamedTuple):
    """A client certificate: PEM, with what stands between it and the authority."""

    chain: str
    expires_ms: int


class Certificates(Protocol):
    """The authority for agents. What a certificate lets its holder do, the broker's rights still say."""

    @property
    def wanted(self) -> bool:
        """Whether the broker lets in nobody without one."""

    async def issue(self, agent: str, request: str) -> Issued:
        """A certificate for an agent: with its id as the common name, whatever the request says.

        Args:
            agent: Its id.
            request: PKCS 10, PEM, signed by the key that it is for.

        Raises:
            CertificateRefused: No such request, a wrong signature, or a kind of key that brokers do not take.
            BrokerAccessError: It cannot be made or kept.
        """

    async def place(self, agent: str, space: str) -> None:
        """Where the broker goes by certificates alone: they are good for this space, and for no other from now on.

        Raises:
            BrokerAccessError: It is not known whether that is so.
        """

    async def revoke(self, agent: str) -> None:
        """No certificate of this agent counts any more. Safe to repeat.

        Raises:
            BrokerAccessError: It is not known whether that is so.
        """

    async def close(self) -> None:
        """Let go of connections."""
