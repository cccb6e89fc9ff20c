"""Signed grants as passwords, where a cloud's broker asks us about each connection: what was issued, what taken back.

The signature is in the password; in the tables is what was issued, so that it can be found to be cut, and what was
revoked, which is checked before a client is admitted.
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
"""Partition ``revoked``: who, and when; partition ``issued``: ``<first two parts of the principal>|<client id>``."""
SETTLE_S = 10.0
"""A connection that was being let in when it was taken back is there by then: brokers wait 5 s for our answer."""
MOST_AT_ONCE = 100
"""Ended in one call, of what has run out: a broker that is away keeps the timer for no longer."""
T = TypeVar("T")
Cut = Callable[[str], Awaitable[None]]
"""Ends the connection of a client id, where there is one."""
_REVOKED, _ISSUED = "revoked", "issued"
_KEEP_S = 86_400.0
"""No grant lives longer: what was taken back before that has run out by itself."""
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
    """Issued and revoked grants, in the tables."""

    def __init__(self, *, keys: SigningKeys, tables: Tables) -> None:
        self._keys = keys
        self._tables = tables

    async def issue(self, grant: Grant) -> Credentials:
        """As ``BrokerAccess.issue``. It is written down first: what was issued can be found again to be cut.

        Raises:
            ProtocolError: The grant is outside the contract.
            BrokerAccessError: It could not be written down.
        """
        grants.check(grant)
        if "|" in grant.principal:
            raise ProtocolError("a principal has no bar")
        issued = _Issued(grant.principal, grant.client_id, grant.expires_at, time.time())
        try:
            await self._write(_ISSUED, f"{_group(grant.principal)}|{grant.client_id}", msgspec.to_builtins(issued))
            return Credentials(grant.principal, await self.signed(grant))
        except StoreError as error:
            raise _said(error) from error

    async def signed(self, grant: Grant) -> str:
        """A password that is not stored anywhere.

        Raises:
            StoreError: There is no key to be had.
        """
        return grants.issue(grant, await self._keys.current())

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> list[str]:
        """Refuse what was issued so far; the client ids that may be connected with it.

        Raises:
            ValueError: Not exactly one of the two was given.
            BrokerAccessError: It could not be written down: the rights may still stand.
        """
        check_revocation(client_id, principal)
        who = f"client:{client_id}" if principal is None else f"principal:{principal}"
        try:
            await self._write(_REVOKED, who, msgspec.to_builtins(_Revoked(time.time())))
            return [client_id] if client_id is not None else await self._clients_of(principal or "")
        except StoreError as error:
            raise _said(error) from error

    async def judge(self, *, username: str, password: str, client_id: str) -> Grant | None:
        """The grant in a password that is good here and now, for this principal and client id.

        Raises:
            StoreError: The revocation state cannot be read; admit no client.
        """
        try:
            known = await self._keys.public(grants.signing_key_id(password))
            grant = grants.read(password, known)
            issued_s = grants.issued_at(password)
        except SignatureError:
            return None
        if (grant.principal, grant.client_id) != (username, client_id) or time.time() >= grant.expires_at:
            return None
        names = [f"client:{client_id}", *(f"principal:{name}" for name in grants.covering(grant.principal))]
        rows = await asyncio.gather(*(self._tables.get(TABLE, _REVOKED, name) for name in names))
        taken_back = any(row is not None and issued_s <= row.data["before_s"] for row in rows)
        return None if taken_back else grant

    async def expire(self, now_s: float, cut: Cut, *, run_out: bool = False) -> None:
        """Forget what has run out; and cut once more what was taken back a moment ago.

        Who was being let in at the moment of a revocation may have come in behind it.

        Args:
            now_s: The time to judge by [s since 1970].
            cut: Ends a client's connection.
            run_out: Whether to end those, too, whose grant has run out: the broker does not by itself.

        Raises:
            BrokerAccessError: The tables or the broker cannot be used; the next call does what this one did not.
        """
        try:
            over = [row for row in await self._rows(_ISSUED) if row.data["expires_at"] <= now_s]
            await each(over[:MOST_AT_ONCE], lambda row: self._end(row, cut if run_out else None))
            for row in await self._rows(_REVOKED):
                revoked = msgspec.convert(row.data, _Revoked)
                if revoked.before_s <= now_s - _KEEP_S:
                    await self._drop(row)
                elif not revoked.settled and revoked.before_s <= now_s - SETTLE_S:
                    await self._settle(row, revoked, cut)
        except StoreError as error:
            raise _said(error) from error

    async def _end(self, row: Row, cut: Cut | None) -> None:
        if cut is not None:
            await cut(row.data["client_id"])
        await self._drop(row)

    async def _settle(self, row: Row, revoked: _Revoked, cut: Cut) -> None:
        what, _, name = row.key.partition(":")
        issued = await self._issued_to(name) if what == "principal" else await self._issued_as(name)
        await each([one.client_id for one in issued if one.issued_s <= revoked.before_s], cut)
        data = msgspec.to_builtins(_Revoked(revoked.before_s, settled=True))
        with contextlib.suppress(Conflict):  # it was taken back again, and will be settled anew
            await self._tables.replace(TABLE, Row(row.partition, row.key, data, row.etag))

    async def _clients_of(self, principal: str) -> list[str]:
        if "+" in _group(principal):
            raise ValueError("a revocation names the account, agent or service")
        return [one.client_id for one in await self._issued_to(principal)]

    async def _issued_to(self, principal: str) -> list[_Issued]:
        group = _group(principal)
        rows = await self._rows(_ISSUED, f"{group}|", f"{group}|{_END}")
        found = [msgspec.convert(row.data, _Issued) for row in rows]
        return [one for one in found if principal in grants.covering(one.principal)]

    async def _issued_as(self, client_id: str) -> list[_Issued]:
        found = [msgspec.convert(row.data, _Issued) for row in await self._rows(_ISSUED)]
        return [one for one in found if one.client_id == client_id]

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
            new = Row(partition, key, data, row.etag if row else "")
            with contextlib.suppress(Conflict):
                await (self._tables.replace(TABLE, new) if row else self._tables.create(TABLE, new))
                return
        raise StoreError("the broker's rights are being changed by too many at once")

    async def _drop(self, row: Row) -> None:
        with contextlib.suppress(Conflict):
            await self._tables.delete(TABLE, row)


async def each(names: Iterable[T], call: Callable[[T], Awaitable[None]]) -> None:
    """All at once. One that fails stops none of the others; the first error is raised when all are done."""
    for outcome in await asyncio.gather(*(call(name) for name in names), return_exceptions=True):
        if outcome is not None:
            raise outcome


def _group(principal: str) -> str:
    """Account, agent or service: what a revocation always names."""
    return ":".join(principal.split(":")[:2])


def _said(error: StoreError) -> BrokerAccessError:
    return BrokerAccessError(str(error).rstrip("."))
