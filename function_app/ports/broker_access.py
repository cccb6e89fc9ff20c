"""Broker permissions: credentials issued from grants, and their revocation.

A grant (``device_agent.protocol.security.grants``) names the exact topics of one connection. The embedded broker reads
it as a signed token. For mosquitto it becomes a client with a role. Callers see no difference.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from device_agent.protocol.security.grants import Grant


class BrokerAccessError(Exception):
    """The broker does not respond or rejects the change; its state is unknown. The text is for operators."""


class Credentials(NamedTuple):
    """Username and password for CONNECT; the grant contains the client id."""

    username: str
    password: str


class ServiceCredentials(NamedTuple):
    """Credentials for a connection of the functions themselves."""

    client_id: str
    username: str
    password: str
    expires_at: float
    """Time to reconnect with new credentials [s since 1970]; ``math.inf`` if they do not expire."""


class BrokerAccess(Protocol):
    """Grants and revokes permissions on one broker.

    Any number of instances and processes may serve one broker; an instance holds no state that matters. The constructor
    opens nothing; the first call that needs a connection opens it. All calls are idempotent. If the broker is not
    reachable, a call raises ``BrokerAccessError`` and may be retried.

    Example::

        credentials = await access.issue(grant)
        await access.revoke(client_id=grant.client_id)
    """

    async def issue(self, grant: Grant) -> Credentials:
        """Credentials for exactly what ``grant`` allows, until ``grant.expires_at``.

        They are valid on return. Issuing again for the same client id keeps earlier credentials and their connection
        valid, so that an agent can renew early.

        Args:
            grant: ``token_id`` must never have been used before.

        Raises:
            ProtocolError: A client id or filter in the grant is not valid on every broker. Nothing was written.
            BrokerAccessError: The broker is not reachable. No valid credentials remain; retry.
        """

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        """Whether this broker accepts a grant with these filters. Makes no request."""

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """Close the connections of a client id or principal, and invalidate all credentials issued for it so far.

        A principal also covers its parts; a part may be the wildcard ``+``: see ``grants.covering``. On return the
        revocation is effective. Credentials issued later are valid. No error if the target does not exist.

        Raises:
            ValueError: Not exactly one of the two arguments was given.
            BrokerAccessError: The broker is not reachable; the permissions may still be valid. Retry.
        """

    async def expire(self, now_s: float) -> None:
        """Delete expired credentials and close their connections, where the broker does not do this itself.

        Call it every few seconds, from any number of instances.

        Raises:
            BrokerAccessError: The broker is not reachable; the next call catches up.
        """

    def service_credentials(self) -> ServiceCredentials:
        """Credentials with a unique client id for a new connection of the functions.

        They allow publishing commands and Stop to every device, subscribing to every agent, and publishing for agents
        that use HTTP. Camera images and setpoints are excluded.

        Raises:
            BrokerAccessError: The key or password file is missing; the text says what to start first.
        """

    async def close(self) -> None:
        """Close the connection. May be called twice."""


def check_revocation(client_id: str | None, principal: str | None) -> None:
    """Check the arguments of ``revoke``.

    Raises:
        ValueError: Not exactly one of them was passed.
    """
    if (client_id is None) == (principal is None):
        raise ValueError("revoke takes exactly one of client_id and principal")
