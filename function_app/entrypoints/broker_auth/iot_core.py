"""The custom authoriser of AWS IoT Core: who may connect as whom, and what may be said and heard there.

Pages connect by WebSocket with what ``mqtt/credentials`` has given them, and name the authoriser in the user name
(``?x-amz-customauthorizer-name=…``), unless it is the account's default one. Agents show certificates instead.
"""

import base64
import binascii
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from function_app.bootstrap import Functions


@runtime_checkable
class _Admits(Protocol):
    async def admit(self, *, username: str, password: str, client_id: str, place: str) -> dict[str, Any]: ...


async def authorise(functions: Functions, event: Mapping[str, Any], function_arn: str) -> dict[str, Any]:
    """The response to one request of IoT Core, which is in the region and account of this function (``function_arn``).

    Raises:
        ValueError: The functions use another broker.
        StoreError: The state cannot be read; IoT Core then admits no client.
    """
    access = functions.access
    if not isinstance(access, _Admits):
        broker = functions.settings.broker
        raise ValueError(f"TELESCOPE_BROKER is {broker}: AWS IoT Core has nothing to ask here")  # noqa: TRY004
    region, account = function_arn.split(":")[3:5]
    asked = event.get("protocolData", {}).get("mqtt", {})
    try:
        password = base64.b64decode(str(asked.get("password", "")), validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        password = ""
    return await access.admit(
        username=str(asked.get("username", "")),
        password=password,
        client_id=str(asked.get("clientId", "")),
        place=f"arn:aws:iot:{region}:{account}",
    )
