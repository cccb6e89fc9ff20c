"""Writes synthetic recordings in the format of the agent."""

import base64
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import simplejpeg
from mcap.writer import CompressionType, Writer

from device_agent.protocol.events import Event
from device_agent.protocol.state import Mode
from device_agent.protocol.telemetry import Measurements
from device_agent.runtime.recording import format as recording_format
from device_agent.runtime.recording.format import ControlRow, SegmentInfo, Source

STARTED_NS: Final = 1_790_000_000_123_456_789
STARTED_TICK_NS: Final = 77_000_000_000_001
FIRST_SEQUENCE: Final = 4_000
WIDTH, HEIGHT = 64, 48
_IMAGE_SCHEMA: Final = {
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}


@dataclass(frozen=True, kw_only=True)
class Session:
    """One synthetic session.

    Attributes:
        periods: Number of control periods.
        missing: Periods without a row.
        cameras: Topic of a camera → periods at which it took an image.
        every: Periods in one segment.
    """

    periods: int = 100
    missing: Collection[int] = ()
    cameras: Mapping[str, Sequence[int]] = field(default_factory=dict)
    every: int = 60
    joints: tuple[str, ...] = ("base", "elbow")
    period_ms: int = 20
    device: str = "arm"
    epoch: int = 6
    events: Mapping[int, str] = field(default_factory=dict)

    def info(self, segment: int) -> SegmentInfo:
        """Metadata of a segment."""
        return SegmentInfo(
            device=self.device,
            robot_type="ur5",
            robot_type_version=3,
            epoch=self.epoch,
            segment=segment,
            holder="Ada",
            joints=self.joints,
            period_ms=self.period_ms,
            cameras=tuple(self.cameras),
            started_ns=STARTED_NS,
            started_tick_ns=STARTED_TICK_NS,
            simulated=True,
            software="0.1.0",
        )

    def time_ns(self, period: int) -> int:
        """Log time of a period [ns since 1970]."""
        return STARTED_NS + period * self.period_ms * 1_000_000

    def row(self, period: int) -> ControlRow:
        """The row of a period. Measured, commanded and applied positions differ, and differ in each period."""
        angles = [math.sin(0.01 * period + joint) for joint in range(len(self.joints))]
        return ControlRow(
            tick_ns=STARTED_TICK_NS + period * self.period_ms * 1_000_000,
            at_ms=self.time_ns(period) // 1_000_000,
            sequence=FIRST_SEQUENCE + period,
            epoch=self.epoch,
            mode=Mode.STREAMING,
            source=Source.OPERATOR,
            position_rad=tuple(angles),
            velocity_rad_s=tuple(0.1 for _ in angles),
            effort_nm=(),
            requested_rad=tuple(angle + 0.3 for angle in angles),
            commanded_rad=tuple(angle + 0.2 for angle in angles),
            applied_rad=tuple(angle + 0.1 for angle in angles),
            twist=(0.25, 0.0, -0.5),
            setpoint_sequence=period,
            limited=("velocity", "workspace"),
        )

    def rows(self) -> Iterator[ControlRow]:
        """All recorded rows."""
        return (self.row(period) for period in range(self.periods) if period not in self.missing)


def pixels(index: int) -> "np.ndarray":
    """The image with this number: a grey level that differs by at least 8 from its neighbours, and a bright corner."""
    image = np.full((HEIGHT, WIDTH, 3), 16 + (index * 37) % 208, dtype=np.uint8)
    image[: HEIGHT // 2, : WIDTH // 2, index % 3] = 240
    return image


def write_session(folder: Path, session: Session, *, finish: Callable[[int], bool] = lambda _: True) -> list[Path]:
    """Write all segments of a session; returns their paths. ``finish(segment)``: whether it has an end and chunks."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for segment in range(math.ceil(session.periods / session.every)):
        paths.append(folder / f"{segment:06d}.mcap")
        _write_segment(paths[-1], session, segment, finished=finish(segment))
    return paths


def _write_segment(path: Path, session: Session, segment: int, *, finished: bool) -> None:
    periods = range(segment * session.every, min((segment + 1) * session.every, session.periods))
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, use_chunking=finished)
        writer.start(profile=recording_format.PROFILE, library="test")
        fields = msgspec.to_builtins(session.info(segment))
        writer.add_metadata(recording_format.METADATA, {name: json.dumps(value) for name, value in fields.items()})
        schema = writer.register_schema("telescope.Message", "jsonschema", b'{"type": "object"}')
        picture = writer.register_schema("foxglove.CompressedImage", "jsonschema", json.dumps(_IMAGE_SCHEMA).encode())
        topics = [recording_format.CONTROL, recording_format.EVENTS, f"{recording_format.MEASUREMENTS}health"]
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in topics}
        channels |= {topic: writer.register_channel(topic, "json", picture) for topic in session.cameras}
        for period in periods:
            time_ns = session.time_ns(period)
            for topic, message in _messages(session, period):
                writer.add_message(channels[topic], time_ns, message, time_ns, period)
        if finished:
            writer.finish()


def _messages(session: Session, period: int) -> Iterator[tuple[str, bytes]]:
    encode = msgspec.json.encode
    # An image is encoded by another thread, so it is often written after later rows; here it is written first.
    for topic, taken in session.cameras.items():
        if period in taken:
            yield topic, _image(session, period, list(taken).index(period))
    if period not in session.missing:
        yield recording_format.CONTROL, encode(session.row(period))
    if period % 10 == 0:
        at_ms = session.time_ns(period) // 1_000_000
        values: dict[str, float | bool] = {"temperature_c.elbow": 30.0 + period}
        measured = Measurements(tick_ms=at_ms, at_ms=at_ms, sequence=period, values=values)
        yield f"{recording_format.MEASUREMENTS}health", encode(measured)
    if period in session.events:
        at_ms = session.time_ns(period) // 1_000_000
        event = Event(
            id=f"e{period}",
            device=session.device,
            at_ms=at_ms,
            kind="motion-held",
            severity="warning",
            message=session.events[period],
        )
        yield recording_format.EVENTS, encode(event)


def _image(session: Session, period: int, index: int) -> bytes:
    seconds, nanoseconds = divmod(session.time_ns(period), 1_000_000_000)
    jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(pixels(index)), quality=95, colorsubsampling="444")
    message = {
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "frame_id": "front",
        "data": base64.b64encode(jpeg).decode(),
        "format": "jpeg",
    }
    return json.dumps(message).encode()
