"""A segment that is being written: an MCAP file without chunks, index and end, of which a crash only cuts the tail."""

import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
from mcap.writer import IndexType, Writer
from msgspec.structs import replace

from device_agent.protocol.events import Event
from device_agent.protocol.telemetry import Measurements
from device_agent.runtime.recording import folder
from device_agent.runtime.recording.format import (
    CONTROL,
    IMAGE_SCHEMA,
    IMAGE_SCHEMA_NAME,
    METADATA,
    PROFILE,
    CompressedImage,
    ControlRow,
    SegmentInfo,
    Timestamp,
)
from device_agent.runtime.recording.messages import Entry, RecordedFrame

_DECIMALS = 6
"""A microradian or a micrometre, far below any encoder; noise digits cannot be compressed."""
_IMAGE = CompressedImage.__name__
_SCHEMAS = {
    kind.__name__: (f"telescope.{kind.__name__}", msgspec.json.schema(kind))
    for kind in (ControlRow, Event, Measurements)
} | {_IMAGE: (IMAGE_SCHEMA_NAME, IMAGE_SCHEMA)}
"""Kind of a message → name and content of its JSON Schema."""


class LiveSegment:
    """Writes one segment. The file is locked until it is sealed, so that no other process recovers it.

    Args:
        path: The file, which must not exist.
        info: Metadata of the segment.

    Raises:
        OSError: The file cannot be created.

    Attributes:
        descriptor: The open file.
        number: Number of the segment.
        size: Size of the file without the metadata [bytes].
    """

    def __init__(self, path: Path, info: SegmentInfo) -> None:
        self.path = path
        self.number = info.segment
        self.size = 0
        self._info = info
        self._buffer = io.BytesIO()
        self._writer = Writer(self._buffer, index_types=IndexType.NONE, use_chunking=False)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.descriptor = folder.create(path)
        import fcntl  # noqa: PLC0415 (Windows has none, and records nothing)

        fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._writer.start(PROFILE)
        self._writer.add_metadata(METADATA, encode_info(info))

    def write(self, rows: Iterable[ControlRow], entries: Iterable[Entry], frames: Iterable[RecordedFrame] = ()) -> None:
        """Append messages. They survive the end of this process at once, and that of the machine after ``sync``.

        Raises:
            OSError: They cannot be written; the file may end with a part of them.
        """
        for row in rows:
            data = msgspec.json.encode(_rounded(row))
            entry = Entry(CONTROL, ControlRow.__name__, row.tick_ns, row.at_ms, data)
            self._add(entry, row.sequence)
        for each in entries:
            self._add(each)
        for frame in frames:
            self._add(Entry(frame.topic, _IMAGE, frame.tick_ns, frame.at_ms, self._image(frame)))
        rest = memoryview(self._buffer.getvalue())
        self._buffer.seek(0)
        self._buffer.truncate()
        self.size += len(rest)
        while rest:
            rest = rest[os.write(self.descriptor, rest) :]

    def _add(self, entry: Entry, sequence: int = 0) -> None:
        topic, schema = entry.topic, entry.schema
        if schema not in self._schemas:
            name, content = _SCHEMAS[schema]
            text = msgspec.json.encode(content)
            self._schemas[schema] = self._writer.register_schema(name, "jsonschema", text)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        log_ns = self._log_ns(entry.tick_ns)
        self._writer.add_message(self._channels[topic], log_ns, entry.data, entry.at_ms * 1_000_000, sequence)

    def _log_ns(self, tick_ns: int) -> int:
        """Log time of a moment. Something that was measured before the session began belongs to its start."""
        return self._info.started_ns + max(0, tick_ns - self._info.started_tick_ns)

    def _image(self, frame: RecordedFrame) -> bytes:
        seconds, nanoseconds = divmod(self._log_ns(frame.tick_ns), 1_000_000_000)
        image = CompressedImage(
            timestamp=Timestamp(sec=seconds, nsec=nanoseconds),
            frame_id=frame.topic.rpartition("/")[2],
            data=frame.data,
            format="jpeg",
        )
        return msgspec.json.encode(image)

    def sync(self) -> None:
        """Write to the disk what the operating system has not written yet.

        Raises:
            OSError: The disk failed.
        """
        os.fdatasync(self.descriptor)


def encode_info(info: SegmentInfo) -> dict[str, str]:
    """The metadata record of a segment."""
    return {name: msgspec.json.encode(getattr(info, name)).decode() for name in info.__struct_fields__}


def decode_info(metadata: dict[str, str]) -> SegmentInfo:
    """The metadata of a segment.

    Raises:
        msgspec.DecodeError: A field is missing or invalid.
    """
    return msgspec.convert({name: msgspec.json.decode(text) for name, text in metadata.items()}, SegmentInfo)


def _rounded(row: ControlRow) -> ControlRow:
    return replace(
        row,
        position_rad=_round(row.position_rad),
        velocity_rad_s=_round(row.velocity_rad_s),
        effort_nm=_round(row.effort_nm),
        requested_rad=_round(row.requested_rad),
        commanded_rad=_round(row.commanded_rad),
        applied_rad=_round(row.applied_rad),
    )


def _round(values: Sequence[float]) -> tuple[float, ...]:
    return tuple([round(value, _DECIMALS) for value in values])
