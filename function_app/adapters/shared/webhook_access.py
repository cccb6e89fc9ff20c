"""Broker permissions in a cloud broker that authenticates for_each connection through the functions."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from device_agent.protocol.security.grants import Grant
from function_app.adapters.shared.grant_registry import GrantRegistry, for_each
from function_app.ports.broker_access import BrokerAccessError, Credentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Tables


class WebhookBrokerAccess(ABC):
    """``BrokerAccess`` with signed grants as passwords. A table stores issued and revoked grants."""

    disconnects_expired = True
    """Whether the broker disconnects a client when its grant expires."""

    def __init__(self, *, keys: SigningKeys, tables: Tables) -> None:
        self._registry = GrantRegistry(keys=keys, tables=tables)

    async def issue(self, grant: Grant) -> Credentials:
        self._check_size(grant)
        return await self._registry.issue(grant)

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
            self._check_size(grant)
        except BrokerAccessError:
            return False
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """See ``BrokerAccess``: clients are rejected from now on, then disconnected."""
        connected = await self._registry.revoke(client_id=client_id, principal=principal)
        await for_each(connected, self._disconnect)

    async def expire(self, now_s: float) -> None:
        await self._registry.expire(now_s, self._disconnect, disconnect_expired=not self.disconnects_expired)

    @abstractmethod
    def _check_size(self, grant: Grant) -> None:
        """Check that the broker can express a grant.

        Raises:
            BrokerAccessError: The grant names too many topics.
        """

    @abstractmethod
    async def _disconnect(self, client_id: str) -> None:
        """Disconnect a client. No error if it is not connected."""
