"""Rows and sessions for tests of recordings, and the messages of recorded files."""

import io
from pathlib import Path
from typing import Any

import msgspec
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from msgspec.structs import replace

from device_agent.protocol import Mode
from device_agent.runtime.recording.format import CONTROL, ControlRow, SegmentInfo, Source
from device_agent.runtime.recording.messages import RecordingLimits

STARTED_NS, STARTED_TICK_NS = 1_700_000_000_000_000_000, 5_000_000_000
PERIOD_MS = 8


def session(device: str = "arm", epoch: int = 7, **changes: Any) -> SegmentInfo:
    info = SegmentInfo(
        device=device,
        robot_type="test",
        robot_type_version=1,
        epoch=epoch,
        segment=0,
        holder="ann",
        joints=("elbow",),
        period_ms=PERIOD_MS,
        cameras=(),
        started_ns=STARTED_NS,
        started_tick_ns=STARTED_TICK_NS,
        simulated=True,
        software="0",
    )
    return replace(info, **changes)


def control_row(sequence: int, **changes: Any) -> ControlRow:
    row = ControlRow(
        tick_ns=STARTED_TICK_NS + sequence * PERIOD_MS * 1_000_000,
        at_ms=STARTED_NS // 1_000_000 + sequence * PERIOD_MS,
        sequence=sequence,
        epoch=7,
        mode=Mode.STREAMING,
        source=Source.OPERATOR,
        position_rad=(0.1234567891,),
        velocity_rad_s=(0.0,),
        effort_nm=(0.0,),
        requested_rad=(0.5,),
        commanded_rad=(0.2,),
        applied_rad=(0.2,),
    )
    return replace(row, **changes)


def control_rows(first: int, count: int) -> tuple[ControlRow, ...]:
    return tuple(control_row(sequence) for sequence in range(first, first + count))


def limits(folder: Path, **changes: Any) -> RecordingLimits:
    base = RecordingLimits(folder=str(folder), max_bytes=10**9, max_age_s=10**6, min_free_bytes=0)
    return replace(base, **changes)


def sealed_messages(path: Path, topic: str = CONTROL) -> list[Any]:
    """Decoded messages of a sealed segment, in the order of their log times."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [msgspec.json.decode(message.data) for _, _, message in reader.iter_messages(topics=[topic])]


def live_sequences(path: Path) -> list[int]:
    """Sequences of the control rows of a segment that is not sealed, up to its end."""
    found: list[int] = []
    try:
        for _, _, message in NonSeekingReader(io.BytesIO(path.read_bytes())).iter_messages(
            topics=[CONTROL], log_time_order=False
        ):
            found.append(msgspec.json.decode(message.data)["sequence"])
    except McapError:  # it has no end
        pass
    return found
