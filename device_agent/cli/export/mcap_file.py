"""MCAP: one file with compressed chunks and an index, for Foxglove and other readers."""

import msgspec
from mcap.writer import CompressionType, Writer

from device_agent.cli.export.request import ExportFormat, ExportRequest
from device_agent.runtime.recording import format as recording_format

EPISODES = "telescope-episodes"
"""Name of the metadata record that contains the exported episodes as JSON."""


def create() -> ExportFormat:
    """The format."""
    return write


def write(request: ExportRequest) -> str:
    """Write one file with all messages of the session or the episodes; returns their number in words.

    It has the metadata of a segment, so that it can be exported again.

    Raises:
        ExportError: The recording cannot be read.
    """
    info = msgspec.structs.replace(request.recording.info, segment=0, cameras=request.recording.cameras)
    fields = msgspec.to_builtins(info)
    count, last_ns = 0, -1
    with request.output.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=recording_format.PROFILE, library="telescope")
        writer.add_metadata(
            recording_format.METADATA, {name: msgspec.json.encode(value).decode() for name, value in fields.items()}
        )
        if request.episodes:
            writer.add_metadata(EPISODES, {"episodes": msgspec.json.encode(list(request.episodes)).decode()})
        channels: dict[str, int] = {}
        schemas: dict[tuple[str, str, bytes], int] = {}
        for first_ns, end_ns in request.spans_ns():
            span_ns = (max(first_ns, last_ns + 1), end_ns)  # episodes may overlap; each message is written once
            for entry in request.progress.count(request.recording.entries(span_ns), "messages"):
                if entry.schema is not None and entry.schema not in schemas:
                    schemas[entry.schema] = writer.register_schema(*entry.schema)
                if entry.topic not in channels:
                    schema = 0 if entry.schema is None else schemas[entry.schema]
                    channels[entry.topic] = writer.register_channel(entry.topic, "json", schema)
                writer.add_message(channels[entry.topic], entry.time_ns, entry.data, entry.publish_ns, count)
                count += 1
            last_ns = max(last_ns, end_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return f"{count} messages"
