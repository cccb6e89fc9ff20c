"""Who may say and hear what on the broker: credentials made from grants, and taken back.

A grant (``device_agent.protocol.security.grants``) names one connection's exact topics. How it reaches the broker differs: the
embedded broker reads a signed token, mosquitto gets a client and a role written into it. Callers see neither.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from device_agent.protocol.security.grants import Grant


class BrokerAccessError(Exception):
    """The broker does not answer or refuses to be told; nothing is known of what was asked. Fit for an operator."""


class Credentials(NamedTuple):
    """What a client gives in its CONNECT, beside the client id of its grant."""

    username: str
    password: str


class ServiceCredentials(NamedTuple):
    """What the functions give in a CONNECT of their own."""

    client_id: str
    username: str
    password: str
    expires_at: float
    """When a new connection has to be made with new ones [s since 1970]; ``math.inf`` where they do not run out."""


class BrokerAccess(Protocol):
    """Gives and takes rights on one broker.

    Any number of instances, in any number of processes, may serve one broker: nothing that matters is kept in them.
    The constructor opens nothing; the first call that needs a connection makes it. All calls are safe to repeat.
    """

    async def issue(self, grant: Grant) -> Credentials:
        """Credentials for exactly what ``grant`` allows, until ``grant.expires_at``.

        They work from the moment of return. Issuing again for the same client id gives other credentials and leaves
        the earlier ones, and a connection made with them, as they are: an agent renews before it must.

        Args:
            grant: ``token_id`` must never have been used before.

        Raises:
            ProtocolError: The grant holds a client id or filter that not every broker takes. Nothing was written.
            BrokerAccessError: The broker cannot be told. Nothing usable was left behind; ask again.
        """

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        """Whether one grant may hold so much on this broker; nobody is asked."""

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """Cut the live connections of a client id or of a principal, and refuse what was issued for it so far.

        A principal stands for what is part of it too, and a part may be ``+`` for any one: ``grants.covering``.

        On return the broker has done so. Credentials issued afterwards work. Revoking what does not exist is no error.

        Raises:
            ValueError: Not exactly one of the two was given.
            BrokerAccessError: The broker cannot be told: the rights may still stand. Ask again.
        """

    async def expire(self, now_s: float) -> None:
        """Forget credentials whose time is over, and end their connections, where the broker does not by itself.

        To be called every few seconds, by any number of instances.

        Args:
            now_s: The time to judge by [s since 1970].

        Raises:
            BrokerAccessError: The broker cannot be told; the next call does what this one did not.
        """

    def service_credentials(self) -> ServiceCredentials:
        """Credentials for a new connection of the functions themselves, with a client id nobody else has.

        They may publish commands and stops to every device, and hear every agent, and speak for one that has told them
        over HTTP, except camera pictures and setpoints.

        Raises:
            BrokerAccessError: The key or password file is not there; the text says what to start first.
        """

    async def close(self) -> None:
        """Let go of the connection. May be called twice."""
