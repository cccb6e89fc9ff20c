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
from collections.abc import Awaitable, Callable
from typing import Any

from device_agent.protocol.security.grants import Grant
from function_app.adapters.azure import topic_spaces
from function_app.adapters.shared.webhook_access import WebhookBrokerAccess
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


class EventGridBrokerAccess(WebhookBrokerAccess):
    """``BrokerAccess`` in an Event Grid namespace, and its webhook's judgement.

    Args:
        keys: Sign and check grants.
        tables: Store issued and revoked grants.
        take: Takes a session over and ends it.
        known: Whether a token is of the namespace's own identity, which alone may ask.
    """

    ends_expired = False

    def __init__(
        self, *, keys: SigningKeys, tables: Tables, take: Take, known: Callable[[str], Awaitable[bool]]
    ) -> None:
        super().__init__(keys=keys, tables=tables)
        self.known = known
        self._take = take
        self._cuts = asyncio.Semaphore(CUTS_AT_ONCE)

    def service_credentials(self) -> ServiceCredentials:
        """None: the functions publish over HTTPS, and hear by the namespace's routing."""
        raise BrokerAccessError("the functions have no connection of their own to Event Grid")

    async def admit(self, *, username: str, password: str, client_id: str) -> dict[str, Any]:
        """What the webhook answers about a connection.

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

    def _check_room(self, grant: Grant) -> None:
        topic_spaces.attributes(grant)

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
