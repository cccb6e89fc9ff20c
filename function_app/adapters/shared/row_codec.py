"""Validation and serialization that all adapters of ``Tables`` share."""

import base64
import binascii
from collections.abc import Sequence
from typing import Any

import msgspec

from function_app.ports.tables import MAX_BATCH, MAX_BATCH_BYTES, MAX_DATA_BYTES, MAX_KEY_LENGTH, SCHEMA, Row, Write

MAX_PAGE = 1_000
_SCHEMA_FIELD = "~schema"
"""Stored with a row's data. No record has a field of this name."""
_SCHEMA_BYTES = len(f',"{_SCHEMA_FIELD}":{SCHEMA}')
"""Not part of the size of the data."""

_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(dict[str, Any]).decode


def check(row: Row) -> None:
    """Check the partition and key of a row to delete; ``encode`` checks those to write.

    Raises:
        ValueError: One is empty, too long, or contains a lone surrogate.
    """
    for text in (row.partition, row.key):
        if not 1 <= len(text) <= MAX_KEY_LENGTH:
            raise ValueError(f"partitions and keys have 1 to {MAX_KEY_LENGTH} characters, not {len(text)}")
        if not is_text(text):
            raise ValueError("partitions and keys are Unicode text without lone surrogates")


def check_batch(writes: Sequence[Write]) -> tuple[bytes, ...]:
    """The data of each write as JSON, empty for a deletion.

    Raises:
        ValueError: No writes, too many writes, too much data, two partitions, a repeated key, or an invalid row.
    """
    if not 1 <= len(writes) <= MAX_BATCH:
        raise ValueError(f"a batch has 1 to {MAX_BATCH} writes, not {len(writes)}")
    keys: set[str] = set()
    texts: list[bytes] = []
    for write in writes:
        if write.row.partition != writes[0].row.partition:
            raise ValueError("all writes of a batch are in one partition")
        if write.row.key in keys:
            raise ValueError("a batch writes each key once")
        keys.add(write.row.key)
        if write.kind == "delete":
            check(write.row)
        texts.append(b"" if write.kind == "delete" else encode(write.row))
    size = sum(map(len, texts)) - _SCHEMA_BYTES * sum(map(bool, texts))
    if size > MAX_BATCH_BYTES:
        raise ValueError(f"a batch writes at most {MAX_BATCH_BYTES} bytes, not {size}; split it")
    return tuple(texts)


def check_limit(limit: int) -> None:
    """Check the maximum number of rows of a page.

    Raises:
        ValueError: It is not 1 to ``MAX_PAGE``.
    """
    if not 1 <= limit <= MAX_PAGE:
        raise ValueError(f"limit must be 1 to {MAX_PAGE}, not {limit}")


def encode(row: Row) -> bytes:
    """A row's data and schema version as JSON, after a check of its partition and key.

    Raises:
        ValueError: More than ``MAX_DATA_BYTES``, or an invalid partition or key; see ``check``.
    """
    usual = row.partition.isascii() and row.key.isascii()
    if not (usual and 0 < len(row.partition) <= MAX_KEY_LENGTH and 0 < len(row.key) <= MAX_KEY_LENGTH):
        check(row)
    text = _encode(row.data)
    if len(text) > MAX_DATA_BYTES:
        raise ValueError(f"a row holds at most {MAX_DATA_BYTES} bytes, not {len(text)}")
    comma = b"," if row.data else b""
    return b'%s%s"%s":%d}' % (text[:-1], comma, _SCHEMA_FIELD.encode(), max(row.schema, SCHEMA))


def decode(partition: str, key: str, text: bytes | str, etag: str) -> Row:
    """A row from its JSON."""
    data = _decode(text)
    return Row(partition, key, data, etag, data.pop(_SCHEMA_FIELD, 0))


def write_cursor(key: str) -> str:
    """The cursor of a page that starts at ``key``."""
    return base64.urlsafe_b64encode(key.encode()).decode().rstrip("=")


def read_cursor(cursor: str) -> str:
    """The first key of the page of a cursor.

    Raises:
        ValueError: It is not a cursor.
    """
    try:
        return base64.b64decode(cursor + "=" * (-len(cursor) % 4), altchars=b"-_", validate=True).decode()
    except (ValueError, binascii.Error) as error:
        raise ValueError("not a cursor of this list") from error


def is_text(text: str) -> bool:
    """Whether a string can be encoded as UTF-8: Python strings may contain lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
