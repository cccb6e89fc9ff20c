"""Requests and responses of measurements, events, latency and uploads."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from device_agent.protocol import Id
from function_app.entrypoints.http.framework.schemas import DeviceName, Moment, Request, Response
from function_app.ports.blobs import MAX_UPLOAD_BYTES
from function_app.services.telemetry.latency import Path, Transport

Resolution = Literal["raw", "10s", "1min", "10min", "1h", "6h", "1d"]


class StreamOut(Response, frozen=True, kw_only=True):
    """A stream of measurements: how many samples it has had since the device was paired, and when."""

    name: str
    samples: int
    first_at: Moment
    last_at: Moment
    fields: tuple[str, ...]


class StreamList(Response, frozen=True, kw_only=True):
    """The streams of a device, by name: all of them."""

    items: tuple[StreamOut, ...]
    cursor: str | None


class ColumnOut(Response, frozen=True, kw_only=True):
    """One field, a value for each of ``at_ms``; null where it was not measured.

    Of ``raw`` samples ``mean`` is the value itself, and the others are empty.
    """

    mean: tuple[float | None, ...]
    min: tuple[float | None, ...] = ()
    max: tuple[float | None, ...] = ()
    last: tuple[float | None, ...] = ()
    count: tuple[int, ...] = ()


class DataOut(Response, frozen=True, kw_only=True):
    """A page of a stream, in columns. ``at_ms``: times of samples, or the beginnings of stretches of ``span_ms``."""

    stream: str
    resolution: Resolution
    span_ms: int
    from_ms: int
    to_ms: int
    at_ms: tuple[int, ...]
    fields: dict[str, ColumnOut]
    cursor: str | None


class EventOut(Response, frozen=True, kw_only=True):
    """An event. ``at`` is the time on its publisher's clock, ``received_at`` on the server's."""

    id: str
    kind: str
    severity: Literal["info", "warning", "error"]
    message: str
    data: dict[str, Any]
    at: Moment
    received_at: Moment


class EventList(Response, frozen=True, kw_only=True):
    """Newest first."""

    items: tuple[EventOut, ...]
    cursor: str | None


Sent = Annotated[int, Meta(ge=0, le=2**53, description="when, by the sender's clock [ms since 1970, UTC]")]
Took = Annotated[float, Meta(ge=0, le=86_400_000, description="how long [ms]")]


class LatencySample(Request, frozen=True, kw_only=True):
    """One time."""

    at_ms: Sent
    ms: Took


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
    """How many were longer than ``above_ms`` and not longer than ``up_to_ms``."""

    above_ms: float
    up_to_ms: float
    count: int


class LatencyOut(Response, frozen=True, kw_only=True):
    """One transport and path. Percentiles are within 1 % of the exact ones; null without samples in the span.

    ``at_ms`` and ``ms`` are the newest raw samples, at most 1,000, oldest first. They may lie outside the span.
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
    """By transport and path. ``since`` and ``until`` is the span asked for, widened to whole hours or days (UTC)."""

    since: Moment
    until: Moment
    items: tuple[LatencyOut, ...]


_WORD = r"[A-Za-z0-9!#$&^_.+-]{1,60}"
ContentType = Annotated[str, Meta(pattern=f"^{_WORD}/{_WORD}$(?!\\n)", description="such as image/png")]
Length = Annotated[int, Meta(ge=0, le=MAX_UPLOAD_BYTES)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Meta(max_length=200)]
AtMs = Annotated[int, Meta(ge=0, le=9_999_999_999_999)]


class UploadRequest(Request, frozen=True, kw_only=True):
    """What shall be uploaded. ``at_ms``: when it was taken [ms since 1970]; now."""

    stream: Id
    length: Length
    content_type: ContentType
    name: FileName = ""
    at_ms: AtMs | None = None
    sha256: Sha256 | None = None


class AgentUploadRequest(UploadRequest, frozen=True, kw_only=True):
    """The same by an agent, of one of its devices."""

    device: DeviceName


class AgentCompleteRequest(Request, frozen=True, kw_only=True):
    """Of which device it is."""

    device: DeviceName


class UploadStarted(Response, frozen=True, kw_only=True):
    """Send the content to ``url`` with ``method`` and exactly these headers, then complete the upload."""

    id: str
    method: str
    url: str
    headers: dict[str, str]
    expires_at: Moment


class UploadOut(Response, frozen=True, kw_only=True):
    """A completed capture. ``verified``: its content has the announced hash."""

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
    """A capture, and where it can be read for an hour."""

    url: str


class UploadList(Response, frozen=True, kw_only=True):
    """Captures, newest first."""

    items: tuple[UploadOut, ...]
    cursor: str | None
