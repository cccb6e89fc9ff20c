"""The custom authorizer of AWS IoT Core: which MQTT clients may connect, and their topics.

Pages connect by WebSocket with credentials from ``mqtt/credentials``. They name the authorizer in the user name
(``?x-amz-customauthorizer-name=…``), unless it is the account's default. Agents use certificates instead.
"""

import base64
import binascii
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from function_app.bootstrap import Functions


@runtime_checkable
class _ConnectAuthorizer(Protocol):
    async def admit(self, *, username: str, password: str, client_id: str, arn_prefix: str) -> dict[str, Any]: ...


async def authorise(functions: Functions, event: Mapping[str, Any], function_arn: str) -> dict[str, Any]:
    """The response to one request of IoT Core. Region and account are those of the function (``function_arn``).

    Raises:
        ValueError: Another broker is configured.
        StoreError: The state cannot be read; IoT Core then admits no client.
    """
    access = functions.access
    if not isinstance(access, _ConnectAuthorizer):
        broker = functions.settings.broker
        raise ValueError(f"TELESCOPE_BROKER is {broker}; the custom authorizer requires iot")  # noqa: TRY004
    region, account = function_arn.split(":")[3:5]
    connect = event.get("protocolData", {}).get("mqtt", {})
    try:
        password = base64.b64decode(str(connect.get("password", "")), validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        password = ""
    return await access.admit(
        username=str(connect.get("username", "")),
        password=password,
        client_id=str(connect.get("clientId", "")),
        arn_prefix=f"arn:aws:iot:{region}:{account}",
    )
