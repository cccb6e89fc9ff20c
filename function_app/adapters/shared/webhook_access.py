"""Broker rights in a cloud's broker that asks the functions about each connection."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from device_agent.protocol.security.grants import Grant
from function_app.adapters.shared.grant_registry import GrantRegistry, each
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables


class WebhookBrokerAccess(ABC):
    """``BrokerAccess`` with signed grants as passwords. A table holds the issued and the revoked ones."""

    ends_expired = True
    """Whether the broker itself ends a connection with its grant."""

    def __init__(self, *, keys: SigningKeys, tables: Tables) -> None:
        self._rights = GrantRegistry(keys=keys, tables=tables)

    async def issue(self, grant: Grant) -> Credentials:
        self._check_room(grant)
        return await self._rights.issue(grant)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        grant = Grant(
            principal="account:",
            client_id="c" * 64,
            publish=tuple(publish),
            subscribe=tuple(subscribe),
            token_id="",
            expires_at=0,
        )
        try:
            self._check_room(grant)
        except BrokerAccessError:
            return False
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """See ``BrokerAccess``: clients are rejected from now on, then disconnected."""
        connected = await self._rights.revoke(client_id=client_id, principal=principal)
        await each(connected, self._cut)

    async def expire(self, now_s: float) -> None:
        await self._rights.expire(now_s, self._cut, run_out=not self.ends_expired)

    @abstractmethod
    def _check_room(self, grant: Grant) -> None:
        """Check that the broker can express a grant.

        Raises:
            BrokerAccessError: It names too many topics.
        """

    @abstractmethod
    async def _cut(self, client_id: str) -> None:
        """End the connection of a client, if there is one."""
