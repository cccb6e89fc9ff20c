"""Messages between the agent and its recorder process, as MessagePack."""

from msgspec import Struct

from device_agent.runtime.recording.format import SEGMENT_BYTES, SEGMENT_S, ControlRow, SegmentInfo


class RecordingLimits(Struct, frozen=True, kw_only=True):
    """What the recorder may use of the disk.

    Attributes:
        folder: Folder of all recordings.
        max_bytes: Maximum size of all recordings [bytes].
        max_age_s: Recordings are deleted after this time [s].
        min_free_bytes: Free space below which nothing is recorded [bytes].
        segment_s: Duration of a segment [s].
        segment_bytes: Size at which a segment ends earlier [bytes].
    """

    folder: str
    max_bytes: int
    max_age_s: float
    min_free_bytes: int
    segment_s: float = SEGMENT_S
    segment_bytes: int = SEGMENT_BYTES


class Entry(Struct, frozen=True, array_like=True):
    """One message besides control rows: topic, name of its schema, monotonic clock [ns], wall clock [ms], and JSON."""

    topic: str
    schema: str
    tick_ns: int
    at_ms: int
    data: bytes


class RecordedFrame(Struct, frozen=True, array_like=True):
    """One JPEG of a camera: topic, time of the exposure on the monotonic [ns] and the wall clock [ms], and the file."""

    topic: str
    tick_ns: int
    at_ms: int
    data: bytes


class Batch(Struct, frozen=True, kw_only=True):
    """New rows and entries of one session; the agent sends the next batch after the response.

    Attributes:
        session: The session; ``segment`` is the lowest number that a new segment may have. ``None``: no session.
        rows: Control periods.
        entries: Other messages.
        frames: Frames of cameras.
        ended: Whether the session has ended.
        closing: Whether the agent ends: the process seals all segments, responds and ends.
    """

    session: SegmentInfo | None = None
    rows: tuple[ControlRow, ...] = ()
    entries: tuple[Entry, ...] = ()
    frames: tuple[RecordedFrame, ...] = ()
    ended: bool = False
    closing: bool = False


class RecorderStatus(Struct, frozen=True, kw_only=True):
    """Response to a batch.

    Attributes:
        error: Why the session is not recorded; empty: all rows of the batch were written.
        segment: Number of the segment with the newest row of the session.
        deleted: Segments that were deleted before their upload, since the last response.
    """

    error: str = ""
    segment: int = 0
    deleted: int = 0
