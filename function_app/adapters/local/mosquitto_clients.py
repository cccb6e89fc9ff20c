"""Names of the clients that the functions create in mosquitto, and a limit for their number."""

from collections.abc import Iterable
from typing import NamedTuple

from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.security.grants import Grant

MAX_PER_CLIENT_ID = 2
"""Valid credentials with the same client id: those in use, and those that renew them."""
MAX_PER_PRINCIPAL = 32
"""Valid credentials of a session for one purpose, such as the tabs of a browser."""


class IssuedClient(NamedTuple):
    """The parts of a username in mosquitto. The role with the same name contains the topics."""

    username: str
    principal: str
    client_id: str
    expires_at: int


def name(grant: Grant) -> IssuedClient:
    """The client of a grant: ``principal/client id/expiration/token id``.

    Raises:
        ProtocolError: A part contains a slash.
    """
    if "/" in grant.principal or "/" in grant.token_id:
        raise ProtocolError("a principal and a token id have no slash")
    username = "/".join((grant.principal, grant.client_id, str(grant.expires_at), grant.token_id))
    return IssuedClient(username, grant.principal, grant.client_id, grant.expires_at)


def parse(username: str) -> IssuedClient | None:
    """The client with this username; ``None`` if the functions did not create it."""
    match username.split("/"):
        case [principal, client_id, end, _] if end.isdecimal():
            return IssuedClient(username, principal, client_id, int(end))
    return None


class ClientQuota:
    """The clients that one instance has issued. New clients replace the oldest ones beyond the limits.

    As with rate limits, each instance counts separately, and expiration removes what a stopped instance has issued.
    """

    def __init__(self) -> None:
        self._issued: dict[str, list[IssuedClient]] = {}

    def add(self, client: IssuedClient, now_s: float) -> list[str]:
        """Count a client; returns the usernames that it replaces."""
        issued = [each for each in self._issued.get(client.principal, ()) if each.expires_at > now_s]
        same = [each for each in issued if each.client_id == client.client_id]
        excess = same[: max(0, len(same) + 1 - MAX_PER_CLIENT_ID)]
        kept = [each for each in issued if each not in excess]
        excess += kept[: max(0, len(kept) + 1 - MAX_PER_PRINCIPAL)]
        self._issued[client.principal] = [each for each in kept if each not in excess] + [client]
        return [each.username for each in excess]

    def remove(self, usernames: Iterable[str]) -> None:
        """Stop counting these clients."""
        for username in usernames:
            client = parse(username)
            if client is not None and client.principal in self._issued:
                rest = [each for each in self._issued[client.principal] if each != client]
                if rest:
                    self._issued[client.principal] = rest
                else:
                    del self._issued[client.principal]
