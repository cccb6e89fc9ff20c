"""Tables in one DynamoDB table.

All of the port's tables share it: one thing to deploy, to back up at one moment and to give rights on, and a new
release that brings a table needs no change there. An item has the attributes

- ``p``: the port's table and the partition, ``Agents/pandora``
- ``k``: the key, so that Amazon's order of strings (their UTF-8 bytes) is the port's; ``names`` tells of long ones
- ``name``: the whole key of a long one
- ``etag``: random, another with each write
- ``data``: the JSON, as text, since Amazon's numbers are not JSON's
"""

import asyncio
import random
import secrets
import time
from collections.abc import Sequence
from typing import Any

from function_app.adapters.aws import names
from function_app.adapters.aws.client import Client, Refused
from function_app.adapters.shared import row_codec
from function_app.ports.tables import Conflict, Page, Row, StoreError, Write

TRIES = 8
"""How often a write is sent that another transaction stood in the way of: they take some milliseconds."""
_PAUSE_S = 0.01
_READY_WITHIN_S = 120
_LOOK_EVERY_S = 0.5

_KEYS = [{"AttributeName": "p", "KeyType": "HASH"}, {"AttributeName": "k", "KeyType": "RANGE"}]
_TYPES = [{"AttributeName": "p", "AttributeType": "S"}, {"AttributeName": "k", "AttributeType": "S"}]
_HOW = "partition key 'p' and sort key 'k', both strings"
_UNFIT = frozenset({"ConditionalCheckFailed", "ConditionalCheckFailedException"})
_IN_THE_WAY = frozenset(
    {"TransactionConflict", "TransactionConflictException", "ThrottlingError", "ProvisionedThroughputExceeded"}
)


class DynamoTables:
    """``Tables`` in the DynamoDB table ``table``. Connects at the first call."""

    def __init__(self, *, table: str, region: str, endpoint: str | None = None) -> None:
        """``endpoint`` is an emulator's address. Credentials come the SDK's own way: a role, or the environment."""
        self._table = table
        self._client = Client(
            "dynamodb",
            what=f"the DynamoDB table '{table}'",
            setting="TELESCOPE_AWS_TABLE",
            how=_HOW,
            region=region,
            endpoint=endpoint,
        )

    async def prepare(self) -> None:
        """Make the table where there is none, and wait until it can be used. Safe to repeat, by many at once.

        Raises:
            StoreError: It cannot be made.
        """
        try:
            await self._client.call(
                "create_table",
                TableName=self._table,
                KeySchema=_KEYS,
                AttributeDefinitions=_TYPES,
                BillingMode="PAY_PER_REQUEST",
            )
        except Refused as error:
            if error.code != "ResourceInUseException":
                raise
        end = time.monotonic() + _READY_WITHIN_S
        while (await self._client.call("describe_table", TableName=self._table))["Table"]["TableStatus"] != "ACTIVE":
            if time.monotonic() > end:
                raise StoreError(f"the DynamoDB table '{self._table}' is still being made. Try again in a minute.")
            await asyncio.sleep(_LOOK_EVERY_S)

    async def get(self, table: str, partition: str, key: str) -> Row | None:
        _check_text(partition, key)
        if not key:
            return None
        place = _place(table, partition, key)
        found = await self._client.call("get_item", TableName=self._table, Key=place, ConsistentRead=True)
        return _row(partition, found["Item"]) if "Item" in found else None

    async def create(self, table: str, row: Row) -> Row:
        return await self._put(table, Write("create", row))

    async def replace(self, table: str, row: Row) -> Row:
        return await self._put(table, Write("replace", row))

    async def delete(self, table: str, row: Row) -> None:
        # As a transaction: the SDK gives it a token, so that when an answer is lost and it asks again, Amazon knows
        # the request. A plain delete would then find nothing and be taken for another's.
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
        question = {
            "TableName": self._table,
            "ConsistentRead": True,
            # One more tells whether there is another page, one more may be ``last`` itself.
            "Limit": limit + 2,
            **_range(_partition(table, partition), start, last),
        }
        found: list[Row] = []
        while True:
            answer = await self._client.call("query", **question)
            some = (_row(partition, item) for item in answer["Items"])
            found += (row for row in some if row.key >= start and (last is None or row.key < last))
            if "LastEvaluatedKey" not in answer or _whole(found, limit):
                break
            question["ExclusiveStartKey"] = answer["LastEvaluatedKey"]
        found.sort(key=lambda row: row.key)
        return Page(tuple(found[:limit]), row_codec.write_cursor(found[limit].key) if len(found) > limit else None)

    async def batch(self, table: str, writes: Sequence[Write]) -> tuple[Row, ...]:
        texts = row_codec.check_batch(writes)
        written = tuple(_written(write) for write in writes)
        items = [_change(table, *each) for each in zip(writes, written, texts, strict=True)]
        changes = [{kind: {"TableName": self._table, **what} for kind, what in item.items()} for item in items]
        try:
            await self._write("transact_write_items", TransactItems=changes)
        except Refused as error:
            wrong = next((row for row, why in zip(written, error.reasons, strict=False) if why in _UNFIT), None)
            if wrong is None:
                raise
            raise Conflict(f"{table}: '{wrong.key}' is not as the writer believed") from error
        return written

    async def close(self) -> None:
        await self._client.close()

    async def _put(self, table: str, write: Write) -> Row:
        row_codec.check(write.row)
        row = _written(write)
        change = _change(table, write, row, row_codec.encode(row.data))["Put"]
        try:
            await self._write("put_item", TableName=self._table, **change)
        except Refused as error:
            if error.code not in _UNFIT:
                raise
            if not (error.tried_again and await self._has(table, row)):
                raise Conflict(f"{table}: '{row.key}' is not as the writer believed") from error
        return row

    async def _has(self, table: str, row: Row) -> bool:
        """Whether this very write is there: its answer was lost, and what the SDK then sent again came too late."""
        found = await self.get(table, row.partition, row.key)
        return found is not None and found.etag == row.etag

    async def _write(self, operation: str, **parameters: Any) -> None:
        """Write, again while another transaction stands in the way of this one.

        Raises:
            Refused: The row is not as the writer believed, or something is wrong.
            StoreError: Concurrent writes caused a conflict at every attempt.
        """
        for attempt in range(TRIES):
            try:
                await self._client.call(operation, **parameters)
            except Refused as error:
                why = {error.code, *error.reasons}
                if not why.isdisjoint(_UNFIT) or why.isdisjoint(_IN_THE_WAY):
                    raise
                reason = error
            else:
                return
            await asyncio.sleep(random.uniform(0.5, 1) * _PAUSE_S * 2**attempt)  # noqa: S311 (spreads writers)
        raise StoreError(
            f"the DynamoDB table '{self._table}' has too much to do: {reason.__cause__}. Try again."
        ) from reason


def _written(write: Write) -> Row:
    row = write.row
    return row if write.kind == "delete" else Row(row.partition, row.key, row.data, secrets.token_hex(8))


def _change(table: str, write: Write, row: Row, text: bytes) -> dict[str, dict[str, Any]]:
    """A write of ``text`` as Amazon's transactions have it; ``row`` has the new ETag."""
    place = _place(table, row.partition, row.key)
    condition: dict[str, Any] = {"ConditionExpression": "attribute_not_exists(p)"}
    if write.kind != "create":
        condition = {
            "ConditionExpression": "etag = :etag",
            "ExpressionAttributeValues": {":etag": {"S": write.row.etag}},
        }
    if write.kind == "delete":
        return {"Delete": {"Key": place, **condition}}
    item = {**place, "etag": {"S": row.etag}, "data": {"S": text.decode()}}
    if names.is_long(row.key):
        item["name"] = {"S": row.key}
    return {"Put": {"Item": item, **condition}}


def _place(table: str, partition: str, key: str) -> dict[str, Any]:
    return {"p": {"S": _partition(table, partition)}, "k": {"S": names.key(key)}}


def _partition(table: str, partition: str) -> str:
    return f"{table}/{names.key(partition)}"


def _row(partition: str, item: dict[str, Any]) -> Row:
    key = item.get("name", item["k"])["S"]
    return Row(partition, key, row_codec.decode(item["data"]["S"]), item["etag"]["S"])


def _range(place: str, start: str, last: str | None) -> dict[str, Any]:
    """The condition on ``p`` and ``k`` that all rows from ``start`` to before ``last`` fulfil, and few others."""
    low = start[: names.HEAD]
    values = {":p": {"S": place}}
    condition = "p = :p"
    if low:
        values[":low"] = {"S": low}
    if last is not None:
        values[":high"] = {"S": last if not names.is_long(last) else last[: names.HEAD] + names.BEHIND_HASHES}
    if low and last is not None:
        condition += " AND k BETWEEN :low AND :high"
    elif low:
        condition += " AND k >= :low"
    elif last is not None:
        condition += " AND k <= :high"
    return {"KeyConditionExpression": condition, "ExpressionAttributeValues": values}


def _whole(found: list[Row], limit: int) -> bool:
    """Whether a page's rows and the next one have been read, for any order of the long keys."""
    return len(found) > limit and not names.same_head(found[limit].key, found[-1].key)


def _check_text(*texts: str) -> None:
    if not all(map(row_codec.is_text, texts)):
        raise ValueError("partitions and keys are Unicode text without lone surrogates")
