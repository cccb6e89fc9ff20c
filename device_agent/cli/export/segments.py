"""Reads one segment of a recording: an MCAP file with JSON messages."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from device_agent.cli.export.errors import ExportError
from device_agent.runtime.recording import format as recording_format
from device_agent.runtime.recording.format import SegmentInfo

T = TypeVar("T")
_DAMAGE = (McapError, ValueError, struct.error, zstandard.ZstdError, EOFError, RuntimeError)
"""What the reader raises at the end of a truncated file, or at damaged bytes."""


class Entry(NamedTuple):
    """One message of a recording.

    Attributes:
        topic: Topic.
        time_ns: Log time [ns since 1970].
        publish_ns: Wall clock of the agent [ns since 1970].
        data: JSON.
        schema: Name, encoding and content of the schema; ``None`` without one.
    """

    topic: str
    time_ns: int
    publish_ns: int
    data: bytes
    schema: tuple[str, str, bytes] | None


class Segment(NamedTuple):
    """A segment file and its metadata."""

    path: Path
    info: SegmentInfo


def open_segment(path: Path) -> Segment:
    """The segment in this file.

    Raises:
        ExportError: The file cannot be read, is no recording, or is damaged before its metadata.
    """
    for record in _records(path, None):
        if isinstance(record, Metadata) and record.name == recording_format.METADATA:
            try:
                fields = {name: msgspec.json.decode(value) for name, value in record.metadata.items()}
                return Segment(path, msgspec.convert(fields, SegmentInfo))
            except msgspec.MsgspecError as error:
                raise ExportError(f"{path} has metadata of another version: {error}; update the agent") from error
    raise ExportError(f"{path} is no recording of Telescope: it contains no metadata '{recording_format.METADATA}'")


def read_entries(segment: Segment, on_damage: Callable[[ExportError], None] | None) -> Iterator[Entry]:
    """All messages of the segment, in the order of the file.

    Args:
        segment: The segment.
        on_damage: Called instead of raising, when no further message is readable.

    Raises:
        ExportError: The file is truncated or damaged.
    """
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    for record in _records(segment.path, on_damage):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            schema = schemas.get(channel.schema_id)
            described = None if schema is None else (schema.name, schema.encoding, schema.data)
            yield Entry(channel.topic, record.log_time, record.publish_time, record.data, described)


def decode(decoder: msgspec.json.Decoder[T], entry: Entry) -> T:
    """The content of a message.

    Raises:
        ExportError: It has another form.
    """
    try:
        return decoder.decode(entry.data)
    except msgspec.MsgspecError as error:
        raise ExportError(f"a message of {entry.topic} cannot be read: {error}; update the agent") from error


def _records(path: Path, on_damage: Callable[[ExportError], None] | None) -> Iterator[Any]:
    try:
        with path.open("rb") as file:
            yield from StreamReader(file, validate_crcs=True).records
    except FileNotFoundError as error:
        raise ExportError(f"{path} does not exist") from error
    except OSError as error:
        raise ExportError(f"{path} cannot be read: {error.strerror}") from error
    except _DAMAGE as error:
        damage = ExportError(f"{path} is truncated or damaged; add --readable to export what can be read")
        if on_damage is None:
            raise damage from error
        on_damage(damage)
