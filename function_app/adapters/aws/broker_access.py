"""Broker permissions in AWS IoT Core: passwords are signed grants, which the custom authorizer turns into policies.

IoT Core calls the authorizer (``admit``) at each connection, and again before the grant expires. Revocations are rows
in the tables, which ``admit`` checks. Connected clients are disconnected through the IoT Core API.
"""

import time
from typing import Any

from device_agent.protocol.security.grants import Grant
from function_app.adapters.aws import iot_policies
from function_app.adapters.aws.client import ServiceError, iot_data_client
from function_app.adapters.shared.webhook_access import WebhookBrokerAccess
from function_app.ports.broker_access import BrokerAccessError, ServiceCredentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError, Tables

_MISSING = "ResourceNotFoundException"


class IotBrokerAccess(WebhookBrokerAccess):
    """``BrokerAccess`` in AWS IoT Core, including the decisions of its custom authorizer."""

    def __init__(self, *, keys: SigningKeys, tables: Tables, region: str, endpoint: str) -> None:
        super().__init__(keys=keys, tables=tables)
        self._client = iot_data_client(region, endpoint)

    def service_credentials(self) -> ServiceCredentials:
        """Always raises: the functions publish through the API and receive messages through IoT rules."""
        raise BrokerAccessError("the functions have no connection of their own to AWS IoT Core")

    async def admit(self, *, username: str, password: str, client_id: str, arn_prefix: str) -> dict[str, Any]:
        """The custom authorizer's response; ``arn_prefix`` is ``arn:aws:iot:<region>:<account>``.

        Raises:
            StoreError: The revocation state cannot be read; the client is not admitted.
        """
        principal = username.partition("?")[0]
        grant = await self._registry.verify(username=principal, password=password, client_id=client_id)
        if grant is None:
            return iot_policies.rejection()
        return iot_policies.admission(grant, arn_prefix=arn_prefix, now_s=time.time())

    async def close(self) -> None:
        await self._client.close()

    def _check_size(self, grant: Grant) -> None:
        iot_policies.documents(grant, arn_prefix=iot_policies.LONGEST_ARN_PREFIX)

    async def _disconnect(self, client_id: str) -> None:
        try:
            await self._client.call("delete_connection", clientId=client_id, cleanSession=True)
        except StoreError as error:
            if not isinstance(error, ServiceError) or error.code != _MISSING:  # not connected
                raise BrokerAccessError(str(error).rstrip(".")) from error
