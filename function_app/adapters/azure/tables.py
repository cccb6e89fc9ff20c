"""Tables in one storage account.

Each of the port's tables is one of Azure's, named with a prefix and made at the first write. An entity has, beside
Azure's own properties,

- ``Data0``, ``Data1`` …: the JSON as text, cut where a property is full
- ``Write``: random, another with each write, so that a write whose answer was lost is known again
- ``Name``: the code of the whole key where ``RowKey`` has only its head (``names``)

The ETag is Azure's. Azure's batches are its entity group transactions.
"""

import contextlib
import itertools
import re
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from function_app.adapters.azure import names
from function_app.adapters.azure.client import ATTEMPTS, Client, Place, Refused, credential, transport
from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, Write

if TYPE_CHECKING:
    from azure.data.tables import TableClient

PROPERTY_BYTES = 64 * 1024
"""Most that one property holds, in UTF-16."""
_PAGE = 1_000
"""Most entities that Azure gives at once."""
_RETRY_S = 0.1
_LONGEST_RETRY_S = 2
_ETAG = re.compile(r'\AW/"[!#-~]+"\Z')
_EXISTS = frozenset({"", "EntityAlreadyExists"})
_WHOLE: Any = {"mode": "replace"}
"""Not "merge", the SDK's own choice, which leaves properties that the new row does not have."""
_GONE = 404
_TAKEN = 409
_CHANGED = 412
_ALWAYS = frozenset({"GET", "PUT", "POST"})
"""What is sent again when the connection breaks: each of our writes is known again by ``Write``."""

T = TypeVar("T")


class AzureTables:
    """``Tables`` in a storage account, whose names begin with ``prefix``. Connects at the first call."""

    def __init__(self, *, place: Place, prefix: str) -> None:
        """``prefix``: letters and digits, a letter first."""
        self._prefix = prefix
        self._client = Client(
            lambda things: _Service(place, things),
            place=place,
            what=f"the Azure tables '{prefix}…'",
            role="Storage Table Data Contributor",
        )

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        place = _place(partition, key)
        if not partition or not key:
            return None
        found = await self._read(table, place)
        return None if found is None else _row(partition, found)

    async def create(self, table: str, row: Row) -> Row:
        row_codec.check(row)
        entity = _entity(row, row_codec.encode(row.data))
        return await self._put(table, row, entity, lambda to: to.create_entity(entity, retry_on_methods=_ALWAYS))

    async def replace(self, table: str, row: Row) -> Row:
        row_codec.check(row)
        _check_etag(table, row)
        entity = _entity(row, row_codec.encode(row.data))
        return await self._put(
            table, row, entity, lambda to: to.update_entity(entity, **_unchanged(row), **_WHOLE), makes=False
        )

    async def delete(self, table: str, row: Row) -> None:
        # As a transaction: for a plain delete of what is not there the SDK says nothing.
        await self.batch(table, [Write("delete", row)])

    async def query(
        self,
        table: str,
        partition: str,
        *,
        first: str = "",
        last: str | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        row_codec.check_limit(limit)
        start = first if cursor is None else max(first, row_codec.read_cursor(cursor))
        condition, parameters = _range(partition, start, last)
        if last is not None and last <= start:
            return Page((), None)
        wanted = limit + 1  # one more tells whether there is another page
        pages = -(-wanted // _PAGE)

        def read(service: _Service) -> list[Row]:
            found = service.table(self._prefix + table).query_entities(
                condition, parameters=parameters, results_per_page=-(-wanted // pages)
            )
            ordered = names.in_order(found, written=_row_key, name=_key, limit=names.MAX_KEY)
            inside = (each for each in ordered if start <= _key(each) and (last is None or _key(each) < last))
            return [_row(partition, each) for each in itertools.islice(inside, wanted)]

        try:
            found = await self._client.call(read)
        except Refused as error:
            if error.status != _GONE:
                raise
            found = []
        return Page(tuple(found[:limit]), row_codec.write_cursor(found[limit].key) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        entities = [
            _place(write.row.partition, write.row.key) if write.kind == "delete" else _entity(write.row, text)
            for write, text in zip(writes, row_codec.check_batch(writes), strict=True)
        ]
        for write in writes:
            if write.kind != "create":
                _check_etag(table, write.row)
        again = {"retry_on_methods": _ALWAYS} if any("Write" in entity for entity in entities) else {}

        def submit(to: "TableClient") -> list[Mapping[str, Any]]:
            pairs = zip(writes, entities, strict=True)
            return to.submit_transaction([_operation(write, entity) for write, entity in pairs], **again)

        try:
            answers = await self._write(table, submit, makes=all(write.kind == "create" for write in writes))
            etags = [str(answer.get("etag")) for answer in answers]
        except Conflict:
            known = await self._known(table, entities)
            if known is None:
                raise
            etags = known
        return tuple(
            write.row if write.kind == "delete" else replace(write.row, etag=etag)
            for write, etag in zip(writes, etags, strict=True)
        )

    async def close(self) -> None:
        await self._client.close()

    async def _put(
        self,
        table: str,
        row: Row,
        entity: dict[str, str],
        write: "Callable[[TableClient], Mapping[str, Any]]",
        *,
        makes: bool = True,
    ) -> Row:
        try:
            answer = await self._write(table, write, makes=makes)
            etag = str(answer["etag"])
        except Conflict:
            known = await self._known(table, [entity])
            if known is None:
                raise
            (etag,) = known
        return replace(row, etag=etag)

    async def _write(self, table: str, write: "Callable[[TableClient], T]", *, makes: bool = True) -> T:
        """Do it, and with ``makes`` (all it does is create) make the table for it where there is none."""
        try:
            return await self._client.call(lambda service: write(service.table(self._prefix + table)))
        except Refused as error:
            if error.status == _GONE and makes:
                await self._client.call(lambda service: service.make(self._prefix + table))
                return await self._write(table, write, makes=False)
            if error.status in {_GONE, _CHANGED} or (error.status == _TAKEN and error.code in _EXISTS):
                raise Conflict(f"{table}: a row is not as the writer believed ({error.code})") from error
            raise

    async def _read(self, table: str, place: dict[str, str]) -> Mapping[str, Any] | None:
        try:
            return await self._client.call(
                lambda service: service.table(self._prefix + table).get_entity(place["PartitionKey"], place["RowKey"])
            )
        except Refused as error:
            if error.status == _GONE:
                return None
            raise

    async def _known(self, table: str, entities: Sequence[dict[str, str]]) -> list[str] | None:
        """ETags of what is there when it is these very writes; ``None`` when another's are there, or one to delete is.

        When an answer was lost, what the SDK then sends again finds its own first writing, which is no conflict.
        """
        etags = []
        for entity in entities:
            found = await self._read(table, entity)
            if entity.get("Write") != (found or {}).get("Write"):
                return None
            etags.append("" if found is None else _etag(found))
        return etags if any("Write" in entity for entity in entities) else None


class _Service:
    """The SDK's client, and one for each table: making one costs as much as a call."""

    def __init__(self, place: Place, things: contextlib.ExitStack) -> None:
        from azure.data.tables import TableServiceClient  # noqa: PLC0415 (costs a quarter of a second)

        options: dict[str, Any] = {
            "transport": transport(),
            "retry_total": ATTEMPTS - 1,
            "retry_backoff_factor": _RETRY_S,
            "retry_backoff_max": _LONGEST_RETRY_S,
        }
        if place.url:
            service = TableServiceClient(place.url, credential=credential(place, things), **options)
        else:
            service = TableServiceClient.from_connection_string(place.connection, **options)
        self._service = things.enter_context(service)
        self._tables: dict[str, TableClient] = {}

    def table(self, name: str) -> "TableClient":
        """One table's client."""
        found = self._tables.get(name)
        if found is None:
            found = self._tables.setdefault(name, self._service.get_table_client(name))
        return found

    def make(self, name: str) -> None:
        """Make a table; others may do so at the same time."""
        self._service.create_table_if_not_exists(name)


def _place(partition: str, key: str) -> dict[str, str]:
    return {
        "PartitionKey": names.fit(names.encode(partition), names.MAX_KEY),
        "RowKey": names.fit(names.encode(key), names.MAX_KEY),
    }


def _entity(row: Row, text: bytes) -> dict[str, str]:
    entity = {**_place(row.partition, row.key), "Write": secrets.token_hex(8)}
    if names.is_cut(entity["RowKey"], names.MAX_KEY):
        entity["Name"] = names.encode(row.key)
    for number, part in enumerate(_parts(text.decode())):
        entity[f"Data{number}"] = part
    return entity


def _parts(text: str) -> Iterator[str]:
    """A text in parts that each fit into a property."""
    units = text.encode("utf-16-le")
    start = 0
    while start < len(units):
        end = min(start + PROPERTY_BYTES, len(units))
        if end < len(units) and 0xD8 <= units[end - 1] <= 0xDB:  # noqa: PLR2004 (the first half of a pair)
            end -= 2
        yield units[start:end].decode("utf-16-le")
        start = end


def _row(partition: str, entity: Mapping[str, Any]) -> Row:
    parts = itertools.takewhile(bool, (entity.get(f"Data{number}", "") for number in itertools.count()))
    return Row(partition, _key(entity), row_codec.decode("".join(parts)), _etag(entity))


def _row_key(entity: Mapping[str, Any]) -> str:
    return str(entity["RowKey"])


def _key(entity: Mapping[str, Any]) -> str:
    return names.decode(entity.get("Name") or entity["RowKey"])


def _etag(entity: Any) -> str:
    return str(entity.metadata["etag"])


def _check_etag(table: str, row: Row) -> None:
    """What is no ETag of Azure's, ``*`` above all, is never sent: it is not the row's."""
    if not _ETAG.match(row.etag):
        raise Conflict(f"{table}: '{row.key}' has changed or is gone")


def _unchanged(row: Row) -> dict[str, Any]:
    """The condition that the row still has its ETag."""
    from azure.core import MatchConditions  # noqa: PLC0415 (only when the SDK is in use)

    return {"etag": row.etag, "match_condition": MatchConditions.IfNotModified}


def _operation(write: Write, entity: dict[str, str]) -> tuple[str, dict[str, str], dict[str, Any]]:
    if write.kind == "create":
        return "create", entity, {}
    if write.kind == "delete":
        return "delete", entity, _unchanged(write.row)
    return "update", entity, {**_unchanged(write.row), **_WHOLE}


def _range(partition: str, start: str, last: str | None) -> tuple[str, dict[str, str]]:
    """A filter that all rows from ``start`` to before ``last`` pass, and few others."""
    condition = "PartitionKey eq @partition and RowKey ge @low"
    parameters = {
        "partition": names.fit(names.encode(partition), names.MAX_KEY),
        "low": names.head(names.encode(start), names.MAX_KEY),
    }
    if last is not None:
        code = names.encode(last)
        cut = names.is_cut(code, names.MAX_KEY)
        condition += " and RowKey lt @high"
        parameters["high"] = names.head(code, names.MAX_KEY) + names.BEHIND_HASHES if cut else code
    return condition, parameters
