"""Broker rights in AWS IoT Core: signed grants as passwords, of which its custom authoriser (``admit``) makes policies.

IoT Core asks the authoriser at each connection, and again before the grant's end. What was taken back is a row in the
tables, which ``admit`` looks at; who is connected is cut by IoT Core's own call for it.
"""

import time
from collections.abc import Sequence
from typing import Any

from device_agent.protocol.security.grants import Grant
from function_app.adapters.aws import iot_policies
from function_app.adapters.aws.client import Client, Refused
from function_app.adapters.shared.grant_registry import GrantRegistry, each
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import StoreError, Tables

_MISSING = "ResourceNotFoundException"
_LONGEST = "arn:aws:iot:ap-southeast-1:123456789012"
"""As long as a place can be."""


class IotBrokerAccess:
    """``BrokerAccess`` in AWS IoT Core, and its authoriser's judgement.

    Args:
        keys: Sign, and check.
        tables: Remember what was issued and taken back.
        region: Amazon's region.
        endpoint: The account's own address for data.
    """

    def __init__(self, *, keys: SigningKeys, tables: Tables, region: str, endpoint: str) -> None:
        self._rights = GrantRegistry(keys=keys, tables=tables)
        self._client = Client(
            "iot-data",
            what="AWS IoT Core",
            setting="TELESCOPE_IOT_ENDPOINT",
            how="aws iot describe-endpoint --endpoint-type iot:Data-ATS",
            region=region,
            endpoint=endpoint,
            address="TELESCOPE_IOT_ENDPOINT",
        )

    async def issue(self, grant: Grant) -> Credentials:
        """As the port says."""
        iot_policies.documents(grant, place=_LONGEST)  # whether there is room for it
        return await self._rights.issue(grant)

    def accepts(self, publish: Sequence[str], subscribe: Sequence[str]) -> bool:
        """As the port says: whether policies have room for it."""
        grant = Grant(
            principal="",
            client_id="c" * 64,
            publish=tuple(publish),
            subscribe=tuple(subscribe),
            token_id="",
            expires_at=0,
        )
        try:
            iot_policies.documents(grant, place=_LONGEST)
        except BrokerAccessError:
            return False
        return True

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """As the port says: refused from now on, then cut."""
        connected = await self._rights.revoke(client_id=client_id, principal=principal)
        await each(connected, self._cut)

    async def expire(self, now_s: float) -> None:
        """Forget what has run out; IoT Core ends connections with their grants."""
        await self._rights.expire(now_s, self._cut)

    def service_credentials(self) -> ServiceCredentials:
        """None: the functions reach AWS IoT Core by its API, and hear of it by its rules."""
        raise BrokerAccessError("the functions have no connection of their own to AWS IoT Core")

    async def admit(self, *, username: str, password: str, client_id: str, place: str) -> dict[str, Any]:
        """What IoT Core's custom authoriser answers about a connection.

        Args:
            username: The principal, and what IoT Core appends after a question mark.
            password: The signed grant.
            client_id: As the client gives it.
            place: ``arn:aws:iot:<region>:<account>``.

        Raises:
            StoreError: The revocation state cannot be read; the client is not admitted.
        """
        grant = await self._rights.judge(username=username.partition("?")[0], password=password, client_id=client_id)
        return iot_policies.refusal() if grant is None else iot_policies.answer(grant, place=place, now_s=time.time())

    async def close(self) -> None:
        """As the port says."""
        await self._client.close()

    async def _cut(self, client_id: str) -> None:
        try:
            await self._client.call("delete_connection", clientId=client_id, cleanSession=True)
        except Refused as error:
            if error.code != _MISSING:  # it is not connected
                raise BrokerAccessError(str(self._client.unusable(error)).rstrip(".")) from error
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error
