"""The authentication webhook of an Event Grid namespace: which MQTT clients may connect, and their topics.

The namespace sends client id, user name and password (base64) of each CONNECT, with a token of its own identity. The
response is 200 with a decision, 401 if the caller is not the namespace, or 404 if another broker is configured. After
an error no client is admitted; the client receives "server unavailable".
"""

import base64
import binascii
from typing import Any, Protocol, runtime_checkable

import msgspec

from function_app.bootstrap import Functions

MAX_BYTES = 65_536
"""Maximum size of a request: a CONNECT with its certificates."""
_OK, _UNAUTHORIZED, _NOT_FOUND = 200, 401, 404
_DENIED = {"decision": "deny", "errorReason": "the request is not a valid CONNECT"}


@runtime_checkable
class _ConnectAuthorizer(Protocol):
    async def verify_caller(self, token: str) -> bool: ...

    async def admit(self, *, username: str, password: str, client_id: str) -> dict[str, Any]: ...


class _ConnectRequest(msgspec.Struct, frozen=True, rename="camel"):
    client_id: str = ""
    user_name: str | None = None
    password: str | None = None


async def admit(functions: Functions, authorization: str, body: bytes) -> tuple[int, dict[str, Any]]:
    """Status and body of the response to one request of the namespace.

    Raises:
        StoreError: The state cannot be read; the namespace then admits no client.
    """
    access = functions.access
    if not isinstance(access, _ConnectAuthorizer):
        return _NOT_FOUND, {}
    scheme, _, token = authorization.partition(" ")
    if scheme.lower() != "bearer" or len(body) > MAX_BYTES or not await access.verify_caller(token.strip()):
        return _UNAUTHORIZED, {}
    try:
        connect = msgspec.json.decode(body, type=_ConnectRequest)
        password = base64.b64decode(connect.password or "", validate=True).decode()
    except (msgspec.MsgspecError, binascii.Error, UnicodeDecodeError, RecursionError):
        return _OK, _DENIED
    decision = await access.admit(username=connect.user_name or "", password=password, client_id=connect.client_id)
    return _OK, decision
