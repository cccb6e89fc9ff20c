"""Broker permissions in an Event Grid namespace: passwords are signed grants, converted to client attributes.

The namespace calls the webhook (``admit``) for each connection. The response contains the authentication name, the
client attributes and the expiration. The attributes express exactly the grant (``topic_spaces``). The authentication
name is the client id, so that no client can take over the session of another client.

Revocations are rows in the tables, which ``admit`` checks. Event Grid has no API to disconnect a client that
authenticates by webhook. Therefore the functions connect with the same client id and no permissions, which takes over
the session and ends the previous connection. They do the same when a grant expires: Microsoft does not document
whether the namespace ends a connection at its ``expiration``.

Sources: Microsoft, "Authenticate with the MQTT broker by using custom webhook authentication" (request and response),
"MQTT features supported" (session takeover requires the same authentication name), "MQTT clients life cycle events"
(``SessionTakenOver``).
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

DISCONNECTOR = "service:disconnector"
"""Principal that takes over a session to end it. Its credentials never leave the server."""
DISCONNECTOR_LIFETIME_S = 60
MAX_CONCURRENT_TAKEOVERS = 16

TakeOver = Callable[[str, Credentials], Awaitable[None]]
"""Connects with a client id and credentials, and disconnects; raises ``BrokerAccessError`` on rejection."""


class EventGridBrokerAccess(WebhookBrokerAccess):
    """``BrokerAccess`` in an Event Grid namespace, including the decisions of its webhook.

    Args:
        keys: Sign and check grants.
        tables: Store issued and revoked grants.
        take_over: Takes over a session and ends it.
        verify_caller: Whether a token identifies the namespace, the only permitted caller.
    """

    disconnects_expired = False

    def __init__(
        self, *, keys: SigningKeys, tables: Tables, take_over: TakeOver, verify_caller: Callable[[str], Awaitable[bool]]
    ) -> None:
        super().__init__(keys=keys, tables=tables)
        self.verify_caller = verify_caller
        self._take_over = take_over
        self._takeovers = asyncio.Semaphore(MAX_CONCURRENT_TAKEOVERS)

    def service_credentials(self) -> ServiceCredentials:
        """Always raises: the functions publish over HTTPS and receive messages through the namespace's routing."""
        raise BrokerAccessError("the functions have no connection of their own to Event Grid")

    async def admit(self, *, username: str, password: str, client_id: str) -> dict[str, Any]:
        """The webhook's response for a connection.

        Raises:
            StoreError: The revocation state cannot be read; the client is not admitted.
        """
        grant = await self._registry.verify(username=username, password=password, client_id=client_id)
        if grant is None:
            return _DENIED
        try:
            attributes = {} if grant.principal == DISCONNECTOR else topic_spaces.attributes(grant)
        except BrokerAccessError:  # issued by a release with larger limits
            return _DENIED
        return {
            "decision": "allow",
            "clientAuthenticationName": grant.client_id,
            "attributes": attributes,
            "expiration": grant.expires_at,
        }

    async def close(self) -> None:
        """No connection remains open."""

    def _check_size(self, grant: Grant) -> None:
        topic_spaces.attributes(grant)

    async def _disconnect(self, client_id: str) -> None:
        grant = Grant(
            principal=DISCONNECTOR,
            client_id=client_id,
            publish=(),
            subscribe=(),
            token_id=secrets.token_hex(16),
            expires_at=int(time.time()) + DISCONNECTOR_LIFETIME_S,
        )
        try:
            password = await self._registry.sign(grant)
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error
        async with self._takeovers:
            await self._take_over(client_id, Credentials(DISCONNECTOR, password))


_DENIED = {"decision": "deny", "errorReason": "not authorised"}
