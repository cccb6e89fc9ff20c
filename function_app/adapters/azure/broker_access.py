"""Broker rights in an Event Grid namespace: signed grants as passwords, of which our webhook makes attributes.

The namespace asks the webhook (``admit``) about each connection: whether, as whom, with what attributes of the client
and until when. They come to exactly the grant (``topic_spaces``). A client's authentication name is its client id, so
no client takes over another client's session, and there is one at a time.

What was taken back is a row in the tables, which ``admit`` looks at. There is no call to end a connection of a client
that the namespace knows from its webhook alone; but the same client that connects again takes its session over, and the
connection before is ended: so the functions connect as the client that is to be cut, with no rights at all, and go. So
they do when a grant has run out: whether the namespace ends a connection at its ``expiration`` is not written anywhere.

Sources: Microsoft, "Authenticate with the MQTT broker by using custom webhook authentication" (what is asked and
answered), "MQTT features supported" (a session is taken over by the same authentication name, and by no other),
"MQTT clients life cycle events" (``SessionTakenOver``).
"""

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from device_agent.protocol.security.grants import Grant
from function_app.adapters.azure import topic_spaces
from function_app.adapters.shared.grant_registry import GrantRegistry, each
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError, Tables

CUTTER = "service:cutter"
"""Client that takes over a session to end it. Its credentials never leave the server."""
CUT_S = 60
"""So long its password is good."""
CUTS_AT_ONCE = 16

Take = Callable[[str, Credentials], Awaitable[None]]
"""Connects with a client id and credentials, and disconnects; raises ``BrokerAccessError`` where it is not let in."""


class EventGridBrokerAccess:
    """``BrokerAccess`` in an Event Grid namespace, and its webhook's judgement.

    Args:
        keys: Sign, and check.
        tables: Remember what was issued and taken back.
        take: Takes a session over and ends it.
        known: Whether a token is of the namespace's own identity, which alone may ask.
    """

    def __init__(
        self, *, keys: SigningKeys, tables: Tables, take: Take, known: Callable[[str], Awaitable[bool]]
    ) -> None:
        self.known = known
        self._rights = GrantRegistry(keys=keys, tables=tables)
        self._take = take
        self._cuts = asyncio.Semaphore(CUTS_AT_ONCE)

    async def issue(self, grant: Grant) -> Credentials:
        """As the port says."""
        topic_spaces.attributes(grant)  # whether there is room for it
        return await self._rights.issue(grant)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        """As the port says, of a person: whether the topic spaces have room for it."""
        grant = Grant(
            principal="account:",
            client_id="",
            publish=tuple(publish),
            subscribe=tuple(subscribe),
            token_id="",
            expires_at=0,
        )
        try:
            topic_spaces.attributes(grant)
        except BrokerAccessError:
            return False
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """As the port says: refused from now on, then cut."""
        connected = await self._rights.revoke(client_id=client_id, principal=principal)
        await each(connected, self._cut)

    async def expire(self, now_s: float) -> None:
        """As the port says."""
        await self._rights.expire(now_s, self._cut, run_out=True)

    def service_credentials(self) -> ServiceCredentials:
        """None: the functions publish over HTTPS, and hear by the namespace's routing."""
        raise BrokerAccessError("the functions have no connection of their own to Event Grid")

    async def admit(self, *, username: str, password: str, client_id: str) -> dict[str, Any]:
        """What the webhook answers about a connection.

        Args:
            username: The principal.
            password: The signed grant.
            client_id: As the client gives it.

        Raises:
            StoreError: The revocation state cannot be read; the client is not admitted.
        """
        grant = await self._rights.judge(username=username, password=password, client_id=client_id)
        if grant is None:
            return _DENIED
        try:
            attributes = {} if grant.principal == CUTTER else topic_spaces.attributes(grant)
        except BrokerAccessError:  # signed when there was room for it
            return _DENIED
        return {
            "decision": "allow",
            "clientAuthenticationName": grant.client_id,
            "attributes": attributes,
            "expiration": grant.expires_at,
        }

    async def close(self) -> None:
        """As the port says: nothing is kept open."""

    async def _cut(self, client_id: str) -> None:
        grant = Grant(
            principal=CUTTER,
            client_id=client_id,
            publish=(),
            subscribe=(),
            token_id=secrets.token_hex(16),
            expires_at=int(time.time()) + CUT_S,
        )
        try:
            password = await self._rights.signed(grant)
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error
        async with self._cuts:
            await self._take(client_id, Credentials(CUTTER, password))


_DENIED = {"decision": "deny", "errorReason": "not authorised"}
