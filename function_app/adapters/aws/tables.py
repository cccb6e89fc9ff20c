"""Tables in one DynamoDB table.

All tables of the port share one DynamoDB table: one deployment, backup and permission, and no change for a new table.
An item has the attributes

- ``p``: the port's table and the partition, ``Agents/pandora``
- ``k``: the key; DynamoDB also sorts strings by their UTF-8 bytes; ``names`` truncates long keys
- ``name``: the full key if ``k`` is truncated
- ``etag``: random, new with each write
- ``data``: the JSON as text, because DynamoDB numbers differ from JSON numbers

A write is acknowledged after it is stored on disks in at least two availability zones; DynamoDB checks and repairs its
replicas.
"""

import asyncio
import random
import secrets
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from function_app.adapters.aws import names
from function_app.adapters.aws.client import Client, ServiceError
from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, StoreError, Write

TRIES = 8
"""Attempts of a write that conflicts with other transactions, which take some milliseconds."""
_PAUSE_S = 0.01
_CREATION_TIMEOUT_S = 120
_POLL_S = 0.5

_KEYS = [{"AttributeName": "p", "KeyType": "HASH"}, {"AttributeName": "k", "KeyType": "RANGE"}]
_TYPES = [{"AttributeName": "p", "AttributeType": "S"}, {"AttributeName": "k", "AttributeType": "S"}]
_CONDITION_FAILED = frozenset({"ConditionalCheckFailed", "ConditionalCheckFailedException"})
_TRANSIENT = frozenset(
    {"TransactionConflict", "TransactionConflictException", "ThrottlingError", "ProvisionedThroughputExceeded"}
)


class DynamoTables:
    """``Tables`` in the DynamoDB table ``table``. Connects at the first call."""

    def __init__(self, *, table: str, region: str, endpoint: str | None = None) -> None:
        """``endpoint`` is an emulator's address. The SDK reads credentials from the role or the environment."""
        self._table = table
        self._client = Client(
            "dynamodb",
            resource=f"the DynamoDB table '{table}'",
            setting="TELESCOPE_AWS_TABLE",
            creation="partition key 'p' and sort key 'k', both strings",
            region=region,
            endpoint=endpoint,
        )

    async def prepare(self) -> None:
        """Create the table if it does not exist, and wait until it is active. Idempotent; allows concurrent calls.

        Raises:
            StoreError: It cannot be created.
        """
        try:
            await self._client.call(
                "create_table",
                TableName=self._table,
                KeySchema=_KEYS,
                AttributeDefinitions=_TYPES,
                BillingMode="PAY_PER_REQUEST",
            )
        except ServiceError as error:
            if error.code != "ResourceInUseException":
                raise
        end = time.monotonic() + _CREATION_TIMEOUT_S
        while (await self._client.call("describe_table", TableName=self._table))["Table"]["TableStatus"] != "ACTIVE":
            if time.monotonic() > end:
                raise StoreError(f"the DynamoDB table '{self._table}' is still being created. Try again in a minute.")
            await asyncio.sleep(_POLL_S)

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        _check_text(partition, key)
        if not key:
            return None
        item_key = _item_key(table, partition, key)
        response = await self._client.call("get_item", TableName=self._table, Key=item_key, ConsistentRead=True)
        return _row(partition, response["Item"]) if "Item" in response else None

    async def create(self, table: str, row: Row) -> Row:
        return await self._put(table, Write("create", row))

    async def replace(self, table: str, row: Row) -> Row:
        return await self._put(table, Write("replace", row))

    async def delete(self, table: str, row: Row) -> None:
        # A transaction has an idempotency token. If the response to a plain delete were lost, the retry of the SDK
        # would find no item and report a conflict.
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
        _check_text(partition, start, last or "")
        if last is not None and last <= start:
            return Page((), None)
        request = {
            "TableName": self._table,
            "ConsistentRead": True,
            # One extra row shows whether there is another page; another one may be ``last`` itself.
            "Limit": limit + 2,
            **_range(_partition(table, partition), start, last),
        }
        found: list[Row] = []
        while True:
            response = await self._client.call("query", **request)
            rows = (_row(partition, item) for item in response["Items"])
            found += (row for row in rows if row.key >= start and (last is None or row.key < last))
            if "LastEvaluatedKey" not in response or _is_complete(found, limit):
                break
            request["ExclusiveStartKey"] = response["LastEvaluatedKey"]
        found.sort(key=lambda row: row.key)
        return Page(tuple(found[:limit]), row_codec.write_cursor(found[limit].key) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        texts = row_codec.check_batch(writes)
        written = tuple(_written(write) for write in writes)
        items = [_change(table, *each) for each in zip(writes, written, texts, strict=True)]
        changes = [{kind: {"TableName": self._table, **change} for kind, change in item.items()} for item in items]
        try:
            await self._write("transact_write_items", TransactItems=changes)
        except ServiceError as error:
            outcomes = zip(written, error.reasons, strict=False)
            conflicting = next((row for row, reason in outcomes if reason in _CONDITION_FAILED), None)
            if conflicting is None:
                raise
            raise Conflict(f"{table}: '{conflicting.key}' does not have the expected ETag") from error
        return written

    async def check(self, *, thorough: bool = False) -> tuple[str, ...]:
        del thorough
        return ()

    def left_bytes(self) -> int | None:
        return None

    async def close(self) -> None:
        await self._client.close()

    async def _put(self, table: str, write: Write) -> Row:
        row = _written(write)
        change = _change(table, write, row, row_codec.encode(row))["Put"]
        try:
            await self._write("put_item", TableName=self._table, **change)
        except ServiceError as error:
            if error.code not in _CONDITION_FAILED:
                raise
            if not (error.retried and await self._has(table, row)):
                raise Conflict(f"{table}: '{row.key}' does not have the expected ETag") from error
        return row

    async def _has(self, table: str, row: Row) -> bool:
        """Whether this write is stored: after a lost response, the retry of the SDK conflicts with it."""
        found = await self.get(table, row.partition, row.key)
        return found is not None and found.etag == row.etag

    async def _write(self, operation: str, **parameters: Any) -> None:
        """Write, and retry while other transactions conflict.

        Raises:
            ServiceError: The condition of a write failed, or the service cannot be used.
            StoreError: Concurrent writes caused a conflict at every attempt.
        """
        for attempt in range(TRIES):
            try:
                await self._client.call(operation, **parameters)
            except ServiceError as error:
                codes = {error.code, *error.reasons}
                if not codes.isdisjoint(_CONDITION_FAILED) or codes.isdisjoint(_TRANSIENT):
                    raise
                reason = error
            else:
                return
            await asyncio.sleep(random.uniform(0.5, 1) * _PAUSE_S * 2**attempt)  # noqa: S311 (spreads writers)
        raise StoreError(
            f"the DynamoDB table '{self._table}' is overloaded: {reason.__cause__}. Try again."
        ) from reason


def _written(write: Write) -> Row:
    row = write.row
    return row if write.kind == "delete" else replace(row, etag=secrets.token_hex(8))


def _change(table: str, write: Write, row: Row, text: bytes) -> dict[str, dict[str, Any]]:
    """The transaction item of a write of ``text``; ``row`` has the new ETag."""
    item_key = _item_key(table, row.partition, row.key)
    condition: dict[str, Any] = {"ConditionExpression": "attribute_not_exists(p)"}
    if write.kind != "create":
        condition = {
            "ConditionExpression": "etag = :etag",
            "ExpressionAttributeValues": {":etag": {"S": write.row.etag}},
        }
    if write.kind == "delete":
        return {"Delete": {"Key": item_key, **condition}}
    item = {**item_key, "etag": {"S": row.etag}, "data": {"S": text.decode()}}
    if names.is_long(row.key):
        item["name"] = {"S": row.key}
    return {"Put": {"Item": item, **condition}}


def _item_key(table: str, partition: str, key: str) -> dict[str, Any]:
    return {"p": {"S": _partition(table, partition)}, "k": {"S": names.key(key)}}


def _partition(table: str, partition: str) -> str:
    return f"{table}/{names.key(partition)}"


def _row(partition: str, item: dict[str, Any]) -> Row:
    key = item.get("name", item["k"])["S"]
    return row_codec.decode(partition, key, item["data"]["S"], item["etag"]["S"])


def _range(partition: str, start: str, last: str | None) -> dict[str, Any]:
    """A condition on ``p`` and ``k`` that matches all rows with ``start`` ≤ key < ``last``, and few others."""
    low = start[: names.HEAD]
    values = {":p": {"S": partition}}
    condition = "p = :p"
    if low:
        values[":low"] = {"S": low}
    if last is not None:
        values[":high"] = {"S": last if not names.is_long(last) else last[: names.HEAD] + names.AFTER_HASHES}
    if low and last is not None:
        condition += " AND k BETWEEN :low AND :high"
    elif low:
        condition += " AND k >= :low"
    elif last is not None:
        condition += " AND k <= :high"
    return {"KeyConditionExpression": condition, "ExpressionAttributeValues": values}


def _is_complete(found: list[Row], limit: int) -> bool:
    """Whether ``found`` contains the page and the next row, for any order of the long keys."""
    return len(found) > limit and not names.same_head(found[limit].key, found[-1].key)


def _check_text(*texts: str) -> None:
    if not all(map(row_codec.is_text, texts)):
        raise ValueError("partitions and keys are Unicode text without lone surrogates")
