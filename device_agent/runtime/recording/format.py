"""Contents of a recording: MCAP files with JSON messages, one file per segment of a session.

A session is the time of one lease, so a device and an epoch name it. Its segments follow one another without overlap.
The log time of a message is the start of the session on the wall clock plus the elapsed time of the monotonic clock, so
it never jumps. The publish time is the wall clock.
"""

from enum import StrEnum
from typing import Annotated, Final, Literal

from msgspec import Meta, Struct

from device_agent.protocol.state import Mode

PROFILE: Final = "telescope"
METADATA: Final = "telescope"
"""Name of the MCAP metadata record that contains the fields of ``SegmentInfo``, each as JSON."""
CONTROL: Final = "/control"
"""Topic of ``ControlRow``, one for each control period."""
EVENTS: Final = "/events"
"""Topic of ``device_agent.protocol.events.Event``: events of the device in this session."""
MEASUREMENTS: Final = "/measurements/"
"""Prefix of topics with ``Measurements`` of the device: ``/measurements/health``."""
ROOM: Final = "/room/"
"""Prefix of topics with ``Measurements`` of room devices: ``/room/{device}/{stream}``."""
FRAMES: Final = "/frames/"
"""Prefix of topics with ``CompressedImage``: ``/frames/{camera}``, or ``/frames/{device}/{camera}`` of room devices.
Cameras are recorded only with the owner's consent."""
SEGMENT_S: Final = 60.0
"""Duration after which a segment ends and the next one begins [s]."""
CHUNK_BYTES: Final = 128 * 1024
"""Size of a chunk before compression [bytes]: a second of rows, so that a reader decodes little to show one row."""
SEGMENT_BYTES: Final = 48_000_000
"""Size after which a segment ends earlier [bytes]; the cloud accepts files of 64 MB."""
OVERVIEW_S: Final = 0.2
"""Time between two samples of an ``Overview`` [s]."""
MAX_OVERVIEW_EVENTS: Final = 100
"""Events in one ``Overview``: 20 KB at most."""
MAX_EVENT_TEXT: Final = 120
"""Length of the text of an event in an ``Overview``; the segment has the whole text."""


class Source(StrEnum):
    """What caused the command of one control period."""

    OPERATOR = "operator"
    """Fresh setpoints of a person or program with the lease."""
    MOVEMENT = "movement"
    """An action: a movement script, a behaviour, or one operation."""
    HOLD = "hold"
    """The agent holds or brakes: at rest, after the watchdog, at an interlock, in a fault."""
    STOP = "stop"
    """Stop is latched."""


class ControlRow(Struct, frozen=True, kw_only=True):
    """One control period. Joint values are in the order of ``SegmentInfo.joints``.

    Attributes:
        tick_ns: Monotonic clock of the observation [ns].
        at_ms: Wall clock of the agent [ms since 1970].
        sequence: Number of the period in the session, from 0. A missing number is a period that could not be recorded.
        epoch: Epoch of the lease; it names the session.
        mode: Mode of the device.
        source: What caused the command.
        position_rad: Measured positions [rad or m].
        velocity_rad_s: Measured velocities.
        effort_nm: Measured efforts.
        requested_rad: Target of the source before limits: of a setpoint, or the final position of a goal; the command
            if the source has no target.
        commanded_rad: Command after limits, as sent to the driver.
        applied_rad: Positions that the driver applied.
        twist: Commanded velocity of the base: forward [m/s], left [m/s], turn [rad/s]; all 0 without a base.
        setpoint_sequence: Number of the setpoint that caused the command; 0 for none.
        seen_tick_ms: Tick of the telemetry that the operator had seen when sending this setpoint [ms]; 0 for none.
        loop_age_ms: Age of that telemetry when the setpoint took effect [ms].
        limited: Limits that changed the command.
    """

    tick_ns: int
    at_ms: int
    sequence: int
    epoch: int
    mode: Mode
    source: Source
    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    requested_rad: tuple[float, ...]
    commanded_rad: tuple[float, ...]
    applied_rad: tuple[float, ...]
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    setpoint_sequence: int = 0
    seen_tick_ms: int = 0
    loop_age_ms: float = 0.0
    limited: tuple[str, ...] = ()


class SegmentInfo(Struct, frozen=True, kw_only=True):
    """Metadata of one segment.

    Attributes:
        version: Version of this format.
        device: Name of the device at its agent.
        robot_type: Its robot type, and ``robot_type_version``.
        epoch: Epoch of the session.
        segment: Number of the segment in the session, from 0.
        holder: Name of the operator, or of the account that started the action.
        joints: Names of the joints.
        period_ms: Control period [ms].
        cameras: Topics of the cameras with frames in this segment.
        started_ns: Log time of the session's start [ns since 1970].
        started_tick_ns: Monotonic clock at that moment [ns].
        simulated: Whether the robot is simulated.
        software: Version of the agent.
    """

    version: Literal[1] = 1
    device: str
    robot_type: str
    robot_type_version: int
    epoch: int
    segment: int
    holder: str
    joints: tuple[str, ...]
    period_ms: int
    cameras: tuple[str, ...]
    started_ns: int
    started_tick_ns: int
    simulated: bool
    software: str


class OverviewEvent(Struct, frozen=True, kw_only=True):
    """An event of one segment for a timeline: ``time_s`` since the start of the session [s], and a short text."""

    time_s: float
    kind: str
    severity: Literal["info", "warning", "error"]
    text: Annotated[str, Meta(max_length=MAX_EVENT_TEXT)]


class Timestamp(Struct, frozen=True, kw_only=True):
    """A time: seconds since 1970, and nanoseconds."""

    sec: int
    nsec: int


class CompressedImage(Struct, frozen=True, kw_only=True):
    """One frame of a camera, in the schema ``foxglove.CompressedImage``.

    Attributes:
        timestamp: Time of the exposure; equals the log time.
        frame_id: Name of the camera.
        data: The file, Base64 in JSON.
        format: Its format: ``jpeg``.
    """

    timestamp: Timestamp
    frame_id: str
    data: bytes
    format: str


IMAGE_SCHEMA_NAME: Final = "foxglove.CompressedImage"
_TIMESTAMP_SCHEMA: Final = {
    "type": "object",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
}
IMAGE_SCHEMA: Final = {
    "title": IMAGE_SCHEMA_NAME,
    "type": "object",
    "properties": {
        "timestamp": _TIMESTAMP_SCHEMA,
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}
"""JSON Schema of ``CompressedImage`` without references, which viewers of MCAP files do not resolve."""


class Overview(Struct, frozen=True, kw_only=True):
    """Samples of one segment for a timeline, about ``OVERVIEW_S`` apart, column by column, and its events.

    ``time_s``: since the start of the session [s]. ``position_rad`` and ``applied_rad`` contain one row of joints for
    each sample. ``source`` and ``mode`` are those of the sample. A time without rows has no samples. ``events``: in
    order of time; of more than ``MAX_OVERVIEW_EVENTS``, the most severe ones. ``events_omitted``: number of the others.
    Overviews of older agents have no events.
    """

    joints: tuple[str, ...]
    time_s: tuple[float, ...]
    position_rad: tuple[tuple[float, ...], ...]
    applied_rad: tuple[tuple[float, ...], ...]
    source: tuple[Source, ...]
    mode: tuple[Mode, ...]
    events: tuple[OverviewEvent, ...] | None = None
    events_omitted: int = 0
