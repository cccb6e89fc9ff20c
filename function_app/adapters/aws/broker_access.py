"""Broker rights in AWS IoT Core: signed grants as passwords, of which its custom authoriser (``admit``) makes policies.

IoT Core asks the authoriser at each connection, and again before the grant's end. What was taken back is a row in the
tables, which ``admit`` looks at; who is connected is cut by IoT Core's own call for it.
"""

import time
from typing import Any

from device_agent.protocol.security.grants import Grant
from function_app.adapters.aws import iot_policies
from function_app.adapters.aws.client import Refused, iot_data_client
from function_app.adapters.shared.webhook_access import WebhookBrokerAccess
from function_app.ports.broker_access import BrokerAccessError, ServiceCredentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError, Tables

_MISSING = "ResourceNotFoundException"
_LONGEST = "arn:aws:iot:ap-southeast-1:123456789012"
"""As long as a place can be."""


class IotBrokerAccess(WebhookBrokerAccess):
    """``BrokerAccess`` in AWS IoT Core, which ends connections with their grants, and its authoriser's judgement."""

    def __init__(self, *, keys: SigningKeys, tables: Tables, region: str, endpoint: str) -> None:
        super().__init__(keys=keys, tables=tables)
        self._client = iot_data_client(region, endpoint)

    def service_credentials(self) -> ServiceCredentials:
        """None: the functions reach AWS IoT Core by its API, and hear of it by its rules."""
        raise BrokerAccessError("the functions have no connection of their own to AWS IoT Core")

    async def admit(self, *, username: str, password: str, client_id: str, place: str) -> dict[str, Any]:
        """What IoT Core's custom authoriser answers at ``place``, ``arn:aws:iot:<region>:<account>``.

        Raises:
            StoreError: The revocation state cannot be read; the client is not admitted.
        """
        grant = await self._rights.judge(username=username.partition("?")[0], password=password, client_id=client_id)
        return iot_policies.refusal() if grant is None else iot_policies.answer(grant, place=place, now_s=time.time())

    async def close(self) -> None:
        await self._client.close()

    def _check_room(self, grant: Grant) -> None:
        iot_policies.documents(grant, place=_LONGEST)

    async def _cut(self, client_id: str) -> None:
        try:
            await self._client.call("delete_connection", clientId=client_id, cleanSession=True)
        except StoreError as error:
            if not isinstance(error, Refused) or error.code != _MISSING:  # it is not connected
                raise BrokerAccessError(str(error).rstrip(".")) from error
