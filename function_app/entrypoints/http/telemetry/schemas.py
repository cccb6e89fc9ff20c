"""Requests and responses of measurements, events, latency and uploads."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import (
    AgentRequest,
    DeviceName,
    Epoch,
    Moment,
    Name,
    Request,
    Response,
)
from function_app.ports.blobs import MAX_BYTES, MAX_UPLOAD_BYTES
from function_app.services.telemetry.latency import Path, Transport

SegmentNumber = Annotated[int, Meta(ge=0, le=999_999)]
SegmentLength = Annotated[int, Meta(ge=1, le=MAX_BYTES)]
Resolution = Literal["raw", "10s", "1min", "10min", "1h", "6h", "1d"]


class StreamOut(Response, frozen=True, kw_only=True):
    """A stream of measurements, with the number and times of its samples since the device was paired."""

    name: str
    samples: int
    first_at: Moment
    last_at: Moment
    fields: tuple[str, ...]


class StreamList(Response, frozen=True, kw_only=True):
    """All streams of a device, by name."""

    items: tuple[StreamOut, ...]
    cursor: str | None


class ColumnOut(Response, frozen=True, kw_only=True):
    """One field, with one value for each time in ``at_ms``; null: not measured.

    For ``raw`` samples, ``mean`` contains the values, and the other lists are empty.
    """

    mean: tuple[float | None, ...]
    min: tuple[float | None, ...] = ()
    max: tuple[float | None, ...] = ()
    last: tuple[float | None, ...] = ()
    count: tuple[int, ...] = ()


class DataOut(Response, frozen=True, kw_only=True):
    """A page of a stream, by column. ``at_ms``: times of the samples, or starts of the time spans of ``span_ms``."""

    stream: str
    resolution: Resolution
    span_ms: int
    from_ms: int
    to_ms: int
    at_ms: tuple[int, ...]
    fields: dict[str, ColumnOut]
    cursor: str | None


class EventOut(Response, frozen=True, kw_only=True):
    """An event. ``at``: time of the publisher's clock. ``received_at``: time of the server's clock."""

    id: str
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    data: dict[str, Any]
    at: Moment
    received_at: Moment


class EventList(Response, frozen=True, kw_only=True):
    """Events, newest first."""

    items: tuple[EventOut, ...]
    cursor: str | None


SampleTime = Annotated[int, Meta(ge=0, le=2**53, description="Time of the sender's clock [ms since 1970]")]
Duration = Annotated[float, Meta(ge=0, le=86_400_000, description="Duration [ms]")]


class LatencySample(Request, frozen=True, kw_only=True):
    """One measured duration."""

    at_ms: SampleTime
    ms: Duration


Samples = Annotated[tuple[LatencySample, ...], Meta(min_length=1, max_length=1000)]


class LatencyRequest(Request, frozen=True, kw_only=True):
    """Samples of one transport and path."""

    transport: Transport
    path: Path
    samples: Samples


class AgentLatencyRequest(Request, frozen=True, kw_only=True):
    """Samples of one transport and path, measured by the agent for one of its devices."""

    device: DeviceName
    transport: Transport
    path: Path
    samples: Samples


class LatencyBin(Response, frozen=True, kw_only=True):
    """Number of samples above ``above_ms`` and up to ``up_to_ms``."""

    above_ms: float
    up_to_ms: float
    count: int


class LatencyOut(Response, frozen=True, kw_only=True):
    """Statistics of one transport and path. Percentiles have an error of at most 1 %; null without samples.

    ``at_ms`` and ``ms``: the newest samples, at most 1,000, oldest first. They may be outside the time span.
    """

    transport: Transport
    path: Path
    count: int
    mean_ms: float | None
    min_ms: float | None
    max_ms: float | None
    p50_ms: float | None
    p90_ms: float | None
    p95_ms: float | None
    p99_ms: float | None
    bins: tuple[LatencyBin, ...]
    at_ms: tuple[int, ...]
    ms: tuple[float, ...]


class LatencyList(Response, frozen=True, kw_only=True):
    """Statistics by transport and path. ``since``, ``until``: the requested span, extended to whole hours or days."""

    since: Moment
    until: Moment
    items: tuple[LatencyOut, ...]


_WORD = r"[A-Za-z0-9!#$&^_.+-]{1,60}"
ContentType = Annotated[str, Meta(pattern=f"^{_WORD}/{_WORD}$(?!\\n)", description="Media type, such as image/png")]
Length = Annotated[int, Meta(ge=0, le=MAX_UPLOAD_BYTES)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Meta(max_length=200)]
AtMs = Annotated[int, Meta(ge=0, le=9_999_999_999_999)]


class UploadRequest(Request, frozen=True, kw_only=True):
    """A file to upload. ``at_ms``: time of the capture [ms since 1970]; null: now."""

    stream: Id
    length: Length
    content_type: ContentType
    name: FileName = ""
    at_ms: AtMs | None = None
    sha256: Sha256 | None = None


class AgentUploadRequest(UploadRequest, frozen=True, kw_only=True):
    """A file to upload for one of the agent's devices."""

    device: DeviceName


class AgentCompleteRequest(Request, frozen=True, kw_only=True):
    """The agent's device."""

    device: DeviceName


class RecordingRequest(AgentRequest, frozen=True, kw_only=True):
    """A segment of a recording. Times are those of its first and last message [ms since 1970]."""

    device: DeviceName
    epoch: Epoch
    segment: SegmentNumber
    started_ms: AtMs
    ended_ms: AtMs
    length: SegmentLength
    sha256: Sha256
    overview_length: SegmentLength
    overview_sha256: Sha256
    cameras: Annotated[tuple[Name, ...], Meta(max_length=16)] = ()
    rows: Annotated[int, Meta(ge=0, le=10_000_000)] = 0


class SegmentRequest(AgentRequest, frozen=True, kw_only=True):
    """Names an announced segment. ``pending``: the other segments of the session that the agent will upload."""

    device: DeviceName
    epoch: Epoch
    segment: SegmentNumber
    pending: Annotated[tuple[SegmentNumber, ...], Meta(max_length=1000)] | None = None


class FileUpload(Response, frozen=True, kw_only=True):
    """Send the content to ``url`` with ``method`` and exactly these headers."""

    method: str
    url: str
    headers: dict[str, str]


class RecordingUpload(Response, frozen=True, kw_only=True):
    """``stored``: nothing is to be done. Otherwise send each file that is not null, then complete the segment."""

    stored: bool
    segment: FileUpload | None = None
    overview: FileUpload | None = None


class UploadStarted(Response, frozen=True, kw_only=True):
    """Send the content to ``url`` with ``method`` and exactly these headers, then complete the upload."""

    id: str
    method: str
    url: str
    headers: dict[str, str]
    expires_at: Moment


class UploadOut(Response, frozen=True, kw_only=True):
    """A completed capture. ``verified``: the content matches the hash in the request."""

    id: str
    stream: str
    name: str
    at: Moment
    content_type: str
    length: int
    sha256: str | None
    verified: bool
    created_by: str
    stored_at: Moment
    expires_at: Moment


class UploadWithUrl(UploadOut, frozen=True, kw_only=True):
    """A capture, with a URL of its content that is valid for one hour."""

    url: str


class UploadList(Response, frozen=True, kw_only=True):
    """Captures, newest first."""

    items: tuple[UploadOut, ...]
    cursor: str | None
