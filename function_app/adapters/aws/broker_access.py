"""Broker rights in AWS IoT Core: signed grants as passwords, of which its custom authoriser (``admit``) makes policies.

IoT Core asks the authoriser at each connection, and again before the grant's end. What was taken back is a row in the
tables, which ``admit`` looks at; who is connected is cut by IoT Core's own call for it.
"""

import asyncio
import contextlib
import time
from typing import Any

import msgspec

from device_agent.protocol import grants
from device_agent.protocol.errors import ProtocolError, SignatureError
from device_agent.protocol.grants import Grant
from function_app.adapters.aws import policies
from function_app.adapters.aws.client import Client, Refused
from function_app.ports.broker_access import BrokerAccessError, Credentials, ServiceCredentials
from function_app.ports.keys import Keys
from function_app.ports.tables import Conflict, Row, StoreError, Tables

TABLE = "BrokerRights"
"""Partition ``revoked``: who, and when; partition ``issued``: ``<first two parts of the principal>|<client id>``."""
_REVOKED, _ISSUED = "revoked", "issued"
_MISSING = "ResourceNotFoundException"
_KEEP_S = 86_400.0
"""No grant lives longer: what was taken back before that has run out by itself."""
_PAGE = 100
_END = "\U0010ffff"
_TRIES = 5


class _Revoked(msgspec.Struct, frozen=True):
    before_s: float


class _Issued(msgspec.Struct, frozen=True):
    principal: str
    client_id: str
    expires_at: int


class IotBrokerAccess:
    """``BrokerAccess`` in AWS IoT Core, and its authoriser's judgement.

    Args:
        keys: Sign, and check.
        tables: Remember what was issued and taken back.
        region: Amazon's region.
        endpoint: The account's own address for data.
    """

    def __init__(self, *, keys: Keys, tables: Tables, region: str, endpoint: str) -> None:
        self._keys = keys
        self._tables = tables
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
        """As the port says. It is written down first: what was issued can be found again to be cut."""
        grants.check(grant)
        if "|" in grant.principal:
            raise ProtocolError("a principal has no bar")
        policies.documents(grant, place="arn:aws:iot:ap-southeast-1:123456789012")  # whether there is room for it
        issued = _Issued(grant.principal, grant.client_id, grant.expires_at)
        try:
            await self._write(_ISSUED, f"{_group(grant.principal)}|{grant.client_id}", msgspec.to_builtins(issued))
            return Credentials(grant.principal, grants.issue(grant, await self._keys.current()))
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error

    async def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        """As the port says: refused from now on, then cut."""
        if (client_id is None) == (principal is None):
            raise ValueError("revoke takes exactly one of client_id and principal")
        who = f"client:{client_id}" if principal is None else f"principal:{principal}"
        try:
            await self._write(_REVOKED, who, {"before_s": time.time()})
            connected = [client_id] if client_id is not None else await self._clients_of(principal or "")
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error
        await asyncio.gather(*(self._cut(each) for each in connected))

    async def expire(self, now_s: float) -> None:
        """Forget what has run out; IoT Core ends connections with their grants."""
        try:
            for row in await self._rows(_ISSUED):
                if row.data["expires_at"] <= now_s:
                    await self._drop(row)
            for row in await self._rows(_REVOKED):
                if row.data["before_s"] <= now_s - _KEEP_S:
                    await self._drop(row)
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error

    def service_credentials(self) -> ServiceCredentials:
        """None: the functions reach AWS IoT Core by its API, and hear of it by its rules."""
        raise BrokerAccessError("the functions have no connection of their own to AWS IoT Core")

    async def admit(self, *, username: str, password: str, client_id: str, place: str) -> dict[str, Any]:
        """What IoT Core's custom authoriser answers about a connection.

        Args:
            username: The principal, and whatever IoT Core hangs on behind a question mark.
            password: The signed grant.
            client_id: As the client gives it.
            place: ``arn:aws:iot:<region>:<account>``.

        Raises:
            StoreError: It is not known whether the grant was taken back: nobody is let in.
        """
        now_s = time.time()
        try:
            known = await self._keys.public(grants.key_of(password))
            grant = grants.read(password, known)
            issued_s = grants.issued_at(password)
        except SignatureError:
            return policies.refusal()
        if (grant.principal, grant.client_id) != (username.partition("?")[0], client_id) or now_s >= grant.expires_at:
            return policies.refusal()
        names = [f"client:{client_id}", *(f"principal:{name}" for name in grants.covering(grant.principal))]
        rows = await asyncio.gather(*(self._tables.get(TABLE, _REVOKED, name) for name in names))
        if any(row is not None and issued_s <= row.data["before_s"] for row in rows):
            return policies.refusal()
        return policies.answer(grant, place=place, now_s=now_s)

    async def close(self) -> None:
        """As the port says."""
        await self._client.close()

    async def _clients_of(self, principal: str) -> list[str]:
        group = _group(principal)
        if "+" in group:
            raise ValueError("a revocation names the account, agent or service")
        rows = await self._rows(_ISSUED, f"{group}|", f"{group}|{_END}")
        found = [msgspec.convert(row.data, _Issued) for row in rows]
        return [each.client_id for each in found if principal in grants.covering(each.principal)]

    async def _cut(self, client_id: str) -> None:
        try:
            await self._client.call("delete_connection", clientId=client_id, cleanSession=True)
        except Refused as error:
            if error.code != _MISSING:  # it is not connected
                raise BrokerAccessError(str(self._client.unusable(error)).rstrip(".")) from error
        except StoreError as error:
            raise BrokerAccessError(str(error).rstrip(".")) from error

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


def _group(principal: str) -> str:
    """Account, agent or service: what a revocation always names."""
    return ":".join(principal.split(":")[:2])
