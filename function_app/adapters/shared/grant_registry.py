"""Issued and revoked grants of a cloud broker that authenticates each connection through the functions.

A password is a signed grant. The tables store which grants were issued, to find the clients to disconnect, and which
were revoked, to reject their passwords.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import Any, TypeVar

import msgspec

from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.security import grants
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import BrokerAccessError, Credentials, check_revocation
from function_app.ports.signing_keys import SigningKeys
from function_app.ports.tables import Conflict, Row, StoreError, Tables

TABLE = "GrantRegistry"
"""Keys in partition ``revoked``: client or principal; in partition ``issued``: ``<account, agent …>|<client id>``."""
SETTLE_S = 10.0
"""A client that was being admitted during its revocation is connected by then: brokers wait 5 s for the response."""
MAX_EXPIRED = 100
"""Maximum number of expired grants per call, so that an unreachable broker does not block the timer."""
T = TypeVar("T")
Disconnect = Callable[[str], Awaitable[None]]
"""Disconnects a client id. No error if it is not connected."""
_REVOKED, _ISSUED = "revoked", "issued"
_RETENTION_S = 86_400.0
"""Maximum lifetime of a grant: an older revocation affects only expired grants."""
_PAGE = 100
_END = "\U0010ffff"
_TRIES = 5


class _Revoked(msgspec.Struct, frozen=True):
    before_s: float
    settled: bool = False


class _Issued(msgspec.Struct, frozen=True):
    principal: str
    client_id: str
    expires_at: int
    issued_s: float = 0.0


class GrantRegistry:
    """Stores issued and revoked grants in the tables."""

    def __init__(self, *, keys: SigningKeys, tables: Tables) -> None:
        self._keys = keys
        self._tables = tables

    async def issue(self, grant: Grant) -> Credentials:
        """See ``BrokerAccess.issue``. The grant is stored first, so that a revocation finds its client.

        Raises:
            ProtocolError: The grant violates the wire contract.
            BrokerAccessError: The grant could not be stored.
        """
        grants.check(grant)
        if "|" in grant.principal:
            raise ProtocolError("a principal has no bar")
        issued = _Issued(grant.principal, grant.client_id, grant.expires_at, time.time())
        try:
            await self._write(_ISSUED, f"{_group(grant.principal)}|{grant.client_id}", msgspec.to_builtins(issued))
            return Credentials(grant.principal, await self.sign(grant))
        except StoreError as error:
            raise _access_error(error) from error

    async def sign(self, grant: Grant) -> str:
        """A password for a grant, without storing the grant.

        Raises:
            StoreError: The signing key is not available.
        """
        return grants.issue(grant, await self._keys.current())

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> list[str]:
        """Revoke all grants issued so far; returns the client ids that may be connected.

        Raises:
            ValueError: Not exactly one of the two arguments was passed.
            BrokerAccessError: The revocation could not be stored; the grants may still be valid.
        """
        check_revocation(client_id, principal)
        target = f"client:{client_id}" if principal is None else f"principal:{principal}"
        try:
            await self._write(_REVOKED, target, msgspec.to_builtins(_Revoked(time.time())))
            return [client_id] if client_id is not None else await self._clients_of(principal or "")
        except StoreError as error:
            raise _access_error(error) from error

    async def verify(self, *, username: str, password: str, client_id: str) -> Grant | None:
        """The grant in a password, or ``None`` if it is not valid now for this principal and client id.

        Raises:
            StoreError: The revocation state cannot be read; admit no client.
        """
        try:
            keys = await self._keys.public(grants.signing_key_id(password))
            grant = grants.read(password, keys)
            issued_s = grants.issued_at(password)
        except SignatureError:
            return None
        if (grant.principal, grant.client_id) != (username, client_id) or time.time() >= grant.expires_at:
            return None
        targets = [f"client:{client_id}", *(f"principal:{name}" for name in grants.covering(grant.principal))]
        rows = await asyncio.gather(*(self._tables.get(TABLE, _REVOKED, target) for target in targets))
        revoked = any(row is not None and issued_s <= row.data["before_s"] for row in rows)
        return None if revoked else grant

    async def expire(self, now_s: float, disconnect: Disconnect, *, disconnect_expired: bool = False) -> None:
        """Delete expired grants, and repeat the disconnections of recent revocations.

        A client that was being admitted during a revocation may have connected after the first disconnection.

        Args:
            now_s: The current time [s since 1970].
            disconnect: Disconnects a client.
            disconnect_expired: Whether to disconnect clients whose grant has expired.

        Raises:
            BrokerAccessError: The tables or the broker cannot be used; the next call continues.
        """
        try:
            expired = [row for row in await self._rows(_ISSUED) if row.data["expires_at"] <= now_s]
            await for_each(
                expired[:MAX_EXPIRED], lambda row: self._delete_expired(row, disconnect if disconnect_expired else None)
            )
            for row in await self._rows(_REVOKED):
                revoked = msgspec.convert(row.data, _Revoked)
                if revoked.before_s <= now_s - _RETENTION_S:
                    await self._delete(row)
                elif not revoked.settled and revoked.before_s <= now_s - SETTLE_S:
                    await self._settle(row, revoked, disconnect)
        except StoreError as error:
            raise _access_error(error) from error

    async def _delete_expired(self, row: Row, disconnect: Disconnect | None) -> None:
        if disconnect is not None:
            await disconnect(row.data["client_id"])
        await self._delete(row)

    async def _settle(self, row: Row, revoked: _Revoked, disconnect: Disconnect) -> None:
        kind, _, name = row.key.partition(":")
        issued = await self._issued_to(name) if kind == "principal" else await self._issued_as(name)
        await for_each([grant.client_id for grant in issued if grant.issued_s <= revoked.before_s], disconnect)
        data = msgspec.to_builtins(_Revoked(revoked.before_s, settled=True))
        with contextlib.suppress(Conflict):  # a newer revocation replaced it
            await self._tables.replace(TABLE, row.changed(data))

    async def _clients_of(self, principal: str) -> list[str]:
        if "+" in _group(principal):
            raise ValueError("a revocation names the account, agent or service")
        return [grant.client_id for grant in await self._issued_to(principal)]

    async def _issued_to(self, principal: str) -> list[_Issued]:
        group = _group(principal)
        rows = await self._rows(_ISSUED, f"{group}|", f"{group}|{_END}")
        issued = [msgspec.convert(row.data, _Issued) for row in rows]
        return [grant for grant in issued if principal in grants.covering(grant.principal)]

    async def _issued_as(self, client_id: str) -> list[_Issued]:
        issued = [msgspec.convert(row.data, _Issued) for row in await self._rows(_ISSUED)]
        return [grant for grant in issued if grant.client_id == client_id]

    async def _rows(self, partition: str, first: str = "", last: str | None = None) -> list[Row]:
        found: list[Row] = []
        cursor: str | None = None
        while True:
            page = await self._tables.query(TABLE, partition, first=first, last=last, limit=_PAGE, cursor=cursor)
            found += page.rows
            cursor = page.cursor
            if cursor is None:
                return found

    async def _write(self, partition: str, key: str, data: dict[str, Any]) -> None:
        for _ in range(_TRIES):
            row = await self._tables.get(TABLE, partition, key)
            with contextlib.suppress(Conflict):
                if row is None:
                    await self._tables.create(TABLE, Row(partition, key, data))
                else:
                    await self._tables.replace(TABLE, row.changed(data))
                return
        raise StoreError("too many concurrent changes of the broker's permissions")

    async def _delete(self, row: Row) -> None:
        with contextlib.suppress(Conflict):
            await self._tables.delete(TABLE, row)


async def for_each(items: Iterable[T], call: Callable[[T], Awaitable[None]]) -> None:
    """Call concurrently for all items. Raises the first error when all calls have ended."""
    for outcome in await asyncio.gather(*(call(item) for item in items), return_exceptions=True):
        if outcome is not None:
            raise outcome


def _group(principal: str) -> str:
    """The account, agent or service, which every revocation names."""
    return ":".join(principal.split(":")[:2])


def _access_error(error: StoreError) -> BrokerAccessError:
    return BrokerAccessError(str(error).rstrip("."))
