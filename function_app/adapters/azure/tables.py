"""Tables in one storage account.

Each table of the port is an Azure table, named with a prefix and created at the first write. In addition to the system
properties, an entity has

- ``Data0``, ``Data1`` …: the JSON as text, split at the maximum size of a property
- ``Write``: random, new with each write, to identify a write whose response was lost
- ``Name``: the code of the full key if ``RowKey`` is truncated (``names``)

The ETag is Azure's. Batches are entity group transactions. A write is acknowledged after it is stored on three replicas
of the storage account's region; Azure checks and repairs them.
"""

import contextlib
import itertools
import re
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from function_app.adapters.azure import names
from function_app.adapters.azure.client import ATTEMPTS, Client, Endpoint, ServiceError, credential, transport
from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, Write

if TYPE_CHECKING:
    from azure.data.tables import TableClient

PROPERTY_BYTES = 64 * 1024
"""Maximum size of a property in UTF-16."""
_PAGE = 1_000
"""Maximum number of entities in a response of Azure."""
_RETRY_S = 0.1
_MAX_RETRY_S = 2
_ETAG = re.compile(r'\AW/"[!#-~]+"\Z')
_EXISTS = frozenset({"", "EntityAlreadyExists"})
_REPLACE: Any = {"mode": "replace"}
"""The default ("merge") would retain properties that the new row does not have."""
_NOT_FOUND = 404
_CONFLICT = 409
_PRECONDITION_FAILED = 412
_RETRIED = frozenset({"GET", "PUT", "POST"})
"""Methods that the SDK retries after a connection error. ``Write`` identifies repeated writes."""

T = TypeVar("T")


class AzureTables:
    """``Tables`` in a storage account. Table names begin with ``prefix``. Connects at the first call."""

    def __init__(self, *, endpoint: Endpoint, prefix: str) -> None:
        """``prefix``: letters and digits, a letter first."""
        self._prefix = prefix
        self._client = Client(
            lambda exit_stack: _Service(endpoint, exit_stack),
            endpoint=endpoint,
            resource=f"the Azure tables '{prefix}…'",
            role="Storage Table Data Contributor",
        )

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        entity_key = _entity_key(partition, key)
        if not partition or not key:
            return None
        entity = await self._read(table, entity_key)
        return None if entity is None else _row(partition, entity)

    async def create(self, table: str, row: Row) -> Row:
        entity = _entity(row, row_codec.encode(row))
        return await self._put(table, row, entity, lambda to: to.create_entity(entity, retry_on_methods=_RETRIED))

    async def replace(self, table: str, row: Row) -> Row:
        entity = _entity(row, row_codec.encode(row))
        _check_etag(table, row)
        return await self._put(
            table, row, entity, lambda to: to.update_entity(entity, **_if_match(row), **_REPLACE), create_table=False
        )

    async def delete(self, table: str, row: Row) -> None:
        # A transaction fails if the entity does not exist; the SDK ignores that for a plain delete.
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
        count = limit + 1  # one extra row shows whether there is another page
        pages = -(-count // _PAGE)

        def read(service: _Service) -> list[Row]:
            found = service.table(self._prefix + table).query_entities(
                condition, parameters=parameters, results_per_page=-(-count // pages)
            )
            ordered = names.sort_by_name(found, key=_row_key, name=_key, limit=names.MAX_KEY)
            matching = (each for each in ordered if start <= _key(each) and (last is None or _key(each) < last))
            return [_row(partition, each) for each in itertools.islice(matching, count)]

        try:
            found = await self._client.call(read)
        except ServiceError as error:
            if error.status != _NOT_FOUND:
                raise
            found = []
        return Page(tuple(found[:limit]), row_codec.write_cursor(found[limit].key) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        entities = [
            _entity_key(write.row.partition, write.row.key) if write.kind == "delete" else _entity(write.row, text)
            for write, text in zip(writes, row_codec.check_batch(writes), strict=True)
        ]
        for write in writes:
            if write.kind != "create":
                _check_etag(table, write.row)
        retry = {"retry_on_methods": _RETRIED} if any("Write" in entity for entity in entities) else {}

        def submit(to: "TableClient") -> list[Mapping[str, Any]]:
            pairs = zip(writes, entities, strict=True)
            return to.submit_transaction([_operation(write, entity) for write, entity in pairs], **retry)

        try:
            responses = await self._write(table, submit, create_table=all(write.kind == "create" for write in writes))
            etags = [str(response.get("etag")) for response in responses]
        except Conflict:
            stored = await self._etags_of_earlier_attempt(table, entities)
            if stored is None:
                raise
            etags = stored
        return tuple(
            write.row if write.kind == "delete" else replace(write.row, etag=etag)
            for write, etag in zip(writes, etags, strict=True)
        )

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        del thorough
        return ()

    def left_bytes(self) -> int | None:
        return None

    async def close(self) -> None:
        await self._client.close()

    async def _put(
        self,
        table: str,
        row: Row,
        entity: dict[str, str],
        write: "Callable[[TableClient], Mapping[str, Any]]",
        *,
        create_table: bool = True,
    ) -> Row:
        try:
            response = await self._write(table, write, create_table=create_table)
            etag = str(response["etag"])
        except Conflict:
            stored = await self._etags_of_earlier_attempt(table, [entity])
            if stored is None:
                raise
            (etag,) = stored
        return replace(row, etag=etag)

    async def _write(self, table: str, write: "Callable[[TableClient], T]", *, create_table: bool = True) -> T:
        """Run a write; ``create_table`` creates a missing table, for writes that only create rows."""
        try:
            return await self._client.call(lambda service: write(service.table(self._prefix + table)))
        except ServiceError as error:
            if error.status == _NOT_FOUND and create_table:
                await self._client.call(lambda service: service.create(self._prefix + table))
                return await self._write(table, write, create_table=False)
            if error.status in {_NOT_FOUND, _PRECONDITION_FAILED} or (
                error.status == _CONFLICT and error.code in _EXISTS
            ):
                raise Conflict(f"{table}: a row does not have the expected ETag ({error.code})") from error
            raise

    async def _read(self, table: str, key: dict[str, str]) -> Mapping[str, Any] | None:
        try:
            return await self._client.call(
                lambda service: service.table(self._prefix + table).get_entity(key["PartitionKey"], key["RowKey"])
            )
        except ServiceError as error:
            if error.status == _NOT_FOUND:
                return None
            raise

    async def _etags_of_earlier_attempt(self, table: str, entities: Sequence[dict[str, str]]) -> list[str] | None:
        """ETags if an earlier attempt of these writes succeeded, otherwise ``None``.

        After a lost response, the retry of the SDK conflicts with its own first attempt.
        """
        etags = []
        for entity in entities:
            stored = await self._read(table, entity)
            if entity.get("Write") != (stored or {}).get("Write"):
                return None
            etags.append("" if stored is None else _etag(stored))
        return etags if any("Write" in entity for entity in entities) else None


class _Service:
    """The SDK's service client, and a cached client per table: creating one is as slow as a call."""

    def __init__(self, endpoint: Endpoint, exit_stack: contextlib.ExitStack) -> None:
        from azure.data.tables import TableServiceClient  # noqa: PLC0415 (costs a quarter of a second)

        options: dict[str, Any] = {
            "transport": transport(),
            "retry_total": ATTEMPTS - 1,
            "retry_backoff_factor": _RETRY_S,
            "retry_backoff_max": _MAX_RETRY_S,
        }
        if endpoint.url:
            service = TableServiceClient(endpoint.url, credential=credential(endpoint, exit_stack), **options)
        else:
            service = TableServiceClient.from_connection_string(endpoint.connection, **options)
        self._service = exit_stack.enter_context(service)
        self._tables: dict[str, TableClient] = {}

    def table(self, name: str) -> "TableClient":
        """The client of one table."""
        client = self._tables.get(name)
        if client is None:
            client = self._tables.setdefault(name, self._service.get_table_client(name))
        return client

    def create(self, name: str) -> None:
        """Create a table. Idempotent; allows concurrent calls."""
        self._service.create_table_if_not_exists(name)


def _entity_key(partition: str, key: str) -> dict[str, str]:
    return {
        "PartitionKey": names.truncate(names.encode(partition), names.MAX_KEY),
        "RowKey": names.truncate(names.encode(key), names.MAX_KEY),
    }


def _entity(row: Row, text: bytes) -> dict[str, str]:
    entity = {**_entity_key(row.partition, row.key), "Write": secrets.token_hex(8)}
    if names.is_truncated(entity["RowKey"], names.MAX_KEY):
        entity["Name"] = names.encode(row.key)
    for number, part in enumerate(_parts(text.decode())):
        entity[f"Data{number}"] = part
    return entity


def _parts(text: str) -> Iterator[str]:
    """The text in parts that fit into a property each."""
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
    return row_codec.decode(partition, _key(entity), "".join(parts), _etag(entity))


def _row_key(entity: Mapping[str, Any]) -> str:
    return str(entity["RowKey"])


def _key(entity: Mapping[str, Any]) -> str:
    return names.decode(entity.get("Name") or entity["RowKey"])


def _etag(entity: Any) -> str:
    return str(entity.metadata["etag"])


def _check_etag(table: str, row: Row) -> None:
    """Never send an invalid ETag: ``*`` would match every row."""
    if not _ETAG.match(row.etag):
        raise Conflict(f"{table}: '{row.key}' does not have the expected ETag")


def _if_match(row: Row) -> dict[str, Any]:
    """The condition that the stored row has the same ETag."""
    from azure.core import MatchConditions  # noqa: PLC0415 (only when the SDK is in use)

    return {"etag": row.etag, "match_condition": MatchConditions.IfNotModified}


def _operation(write: Write, entity: dict[str, str]) -> tuple[str, dict[str, str], dict[str, Any]]:
    if write.kind == "create":
        return "create", entity, {}
    if write.kind == "delete":
        return "delete", entity, _if_match(write.row)
    return "update", entity, {**_if_match(write.row), **_REPLACE}


def _range(partition: str, start: str, last: str | None) -> tuple[str, dict[str, str]]:
    """A filter that matches all rows with ``start`` ≤ key < ``last``, and few others."""
    condition = "PartitionKey eq @partition and RowKey ge @low"
    parameters = {
        "partition": names.truncate(names.encode(partition), names.MAX_KEY),
        "low": names.head(names.encode(start), names.MAX_KEY),
    }
    if last is not None:
        code = names.encode(last)
        truncated = names.is_truncated(code, names.MAX_KEY)
        condition += " and RowKey lt @high"
        parameters["high"] = names.head(code, names.MAX_KEY) + names.AFTER_HASHES if truncated else code
    return condition, parameters
