"""The webhook of an Event Grid namespace: who may connect as whom, and what may be said and heard there.

The namespace sends each CONNECT's client id, user name and password (base 64) with a token of its own identity. It is
answered 200 with a decision, 401 where it is not the namespace that asks, 404 where another broker is in use. An error
admits no client; the client receives "server unavailable".
"""

import base64
import binascii
from typing import Any, Protocol, runtime_checkable

import msgspec

from function_app.bootstrap import Functions

MAX_BYTES = 65_536
"""A whole CONNECT with its certificates."""
_OK, _UNAUTHORIZED, _NOT_FOUND = 200, 401, 404
_DENIED = {"decision": "deny", "errorReason": "not a CONNECT that can be read"}


@runtime_checkable
class _Admits(Protocol):
    async def known(self, token: str) -> bool: ...

    async def admit(self, *, username: str, password: str, client_id: str) -> dict[str, Any]: ...


class _Asked(msgspec.Struct, frozen=True, rename="camel"):
    client_id: str = ""
    user_name: str | None = None
    password: str | None = None


async def admit(functions: Functions, authorization: str, body: bytes) -> tuple[int, dict[str, Any]]:
    """Status and body of the response to one request of the namespace.

    Raises:
        StoreError: The state cannot be read; the namespace then admits no client.
    """
    access = functions.access
    if not isinstance(access, _Admits):
        return _NOT_FOUND, {}
    scheme, _, token = authorization.partition(" ")
    if scheme.lower() != "bearer" or len(body) > MAX_BYTES or not await access.known(token.strip()):
        return _UNAUTHORIZED, {}
    try:
        asked = msgspec.json.decode(body, type=_Asked)
        password = base64.b64decode(asked.password or "", validate=True).decode()
    except (msgspec.MsgspecError, binascii.Error, UnicodeDecodeError, RecursionError):
        return _OK, _DENIED
    answer = await access.admit(username=asked.user_name or "", password=password, client_id=asked.client_id)
    return _OK, answer
