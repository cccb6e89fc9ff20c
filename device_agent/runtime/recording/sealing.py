"""Seals segments: writes them again with compressed chunks and an index, and writes their overview.

A segment that a crash has left ends anywhere. It is cut after its last whole message.
"""

import contextlib
import io
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from device_agent.protocol.events import Event, EventKind
from device_agent.runtime.recording import folder
from device_agent.runtime.recording.format import (
    CHUNK_BYTES,
    CONTROL,
    EVENTS,
    FRAMES,
    MAX_EVENT_TEXT,
    MAX_OVERVIEW_EVENTS,
    METADATA,
    OVERVIEW_S,
    PROFILE,
    ControlRow,
    Overview,
    OverviewEvent,
)
from device_agent.runtime.recording.live_segment import decode_info

_INTERVAL_NS = round(OVERVIEW_S * 1e9)
_SEVERITIES = ("error", "warning", "info")
_DAMAGED = (McapError, struct.error, UnicodeDecodeError, msgspec.DecodeError, OverflowError)
"""Errors of the reader at a damaged record."""


@dataclass(slots=True)
class _Content:
    """What can be read of a segment that is not complete.

    ``samples``: time since the start of the session [ns], and the first row in each interval of ``OVERVIEW_S``.
    ``events``: time since the start of the session [ns], and the event.
    """

    metadata: dict[str, str] = field(default_factory=dict)
    started_ns: int = 0
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    samples: list[tuple[int, ControlRow]] = field(default_factory=list)
    events: list[tuple[int, Event]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class SegmentSummary:
    """Begin and end of a sealed segment [ms since 1970], its number of control rows, and topics of its cameras."""

    started_ms: int
    ended_ms: int
    rows: int
    cameras: tuple[str, ...]


def lock(live: Path) -> int | None:
    """Open a segment that no process writes or seals; ``None``: one does, or it does not exist any more.

    Raises:
        OSError: It cannot be opened.
    """
    try:
        descriptor = os.open(live, os.O_RDWR)
    except FileNotFoundError:
        return None
    import fcntl  # noqa: PLC0415 (Windows has none, and records nothing)

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def seal(live: Path) -> None:
    """Replace a segment that is not complete by a complete one. A segment without a whole message is deleted.

    Repeating it after an interruption has the same result. The caller has locked the file.

    Raises:
        OSError: The disk failed or is full; the segment remains as it is.
    """
    sealed = live.with_suffix(".mcap")
    content = _read(live.read_bytes())
    if content.messages and not sealed.exists():
        folder.write_file(folder.overview_of(sealed), lambda file: file.write(msgspec.json.encode(_overview(content))))
        folder.write_file(sealed, lambda file: _write_segment(file, content))
    live.unlink(missing_ok=True)


def describe(sealed: Path) -> SegmentSummary:
    """The summary of a sealed segment.

    Raises:
        OSError: It cannot be read, or is not a sealed segment.
    """
    with sealed.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
        except _DAMAGED as error:
            raise OSError(f"{sealed} is damaged: {error}") from error
    if summary is None or summary.statistics is None:
        raise OSError(f"{sealed} is damaged: it has no index")
    statistics = summary.statistics
    control = [channel.id for channel in summary.channels.values() if channel.topic == CONTROL]
    rows = sum(statistics.channel_message_counts.get(number, 0) for number in control)
    started_ms, ended_ms = statistics.message_start_time // 10**6, statistics.message_end_time // 10**6
    return SegmentSummary(started_ms, ended_ms, rows, _cameras(summary.channels))


def _read(data: bytes) -> _Content:
    """Everything up to the first record that is damaged or cut."""
    content = _Content()
    with contextlib.suppress(*_DAMAGED):
        for record in StreamReader(io.BytesIO(data), record_size_limit=len(data)).records:
            match record:
                case Metadata(metadata=metadata):
                    content.started_ns = decode_info(metadata).started_ns
                    content.metadata = metadata
                case Schema():
                    content.schemas[record.id] = record
                case Channel():
                    content.channels[record.id] = record
                case Message():
                    if record.channel_id not in content.channels:
                        break
                    _add_message(content, record)
                case Header():
                    pass
                case _:
                    break
    return content


def _add_message(content: _Content, message: Message) -> None:
    topic = content.channels[message.channel_id].topic
    elapsed_ns = message.log_time - content.started_ns
    if topic == CONTROL:
        row = msgspec.json.decode(message.data, type=ControlRow)
        if not content.samples or content.samples[-1][0] // _INTERVAL_NS != elapsed_ns // _INTERVAL_NS:
            content.samples.append((elapsed_ns, row))
    elif topic == EVENTS:
        event = msgspec.json.decode(message.data, type=Event)
        if event.kind != EventKind.ACTIVITY:  # sums, which the cloud has with the session
            content.events.append((elapsed_ns, event))
    else:
        msgspec.json.decode(message.data)
    content.messages.append(message)


def _write_segment(file: io.BufferedWriter, content: _Content) -> None:
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(PROFILE)
    cameras = msgspec.json.encode(_cameras(content.channels)).decode()
    writer.add_metadata(METADATA, content.metadata | {"cameras": cameras})
    channels = {}
    schemas = {
        number: writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, schema in content.schemas.items()
    }
    for number, channel in content.channels.items():
        schema = schemas[channel.schema_id]
        channels[number] = writer.register_channel(channel.topic, channel.message_encoding, schema)
    for message in content.messages:
        writer.add_message(
            channels[message.channel_id], message.log_time, message.data, message.publish_time, message.sequence
        )
    writer.finish()  # type: ignore[no-untyped-call]


def _cameras(channels: Mapping[int, Channel]) -> tuple[str, ...]:
    return tuple(sorted(channel.topic for channel in channels.values() if channel.topic.startswith(FRAMES)))


def _overview(content: _Content) -> Overview:
    samples = content.samples
    events = sorted(content.events, key=lambda each: each[0])
    kept = sorted(events, key=lambda each: _SEVERITIES.index(each[1].severity))[:MAX_OVERVIEW_EVENTS]
    return Overview(
        joints=decode_info(content.metadata).joints,
        time_s=tuple(round(elapsed_ns / 1e9, 3) for elapsed_ns, _ in samples),
        position_rad=tuple(row.position_rad for _, row in samples),
        applied_rad=tuple(row.applied_rad for _, row in samples),
        source=tuple(row.source for _, row in samples),
        mode=tuple(row.mode for _, row in samples),
        events=tuple(_overview_event(*each) for each in sorted(kept, key=lambda each: each[0])),
        events_omitted=len(events) - len(kept),
    )


def _overview_event(elapsed_ns: int, event: Event) -> OverviewEvent:
    text = event.message if len(event.message) <= MAX_EVENT_TEXT else f"{event.message[: MAX_EVENT_TEXT - 1]}…"
    return OverviewEvent(time_s=round(elapsed_ns / 1e9, 3), kind=event.kind, severity=event.severity, text=text)
