"""``latency``: how long things take."""

from typing import Annotated

from msgspec import Meta

from function_app.entrypoints.http.framework.schemas import DeviceName, Moment, Request, Response
from function_app.services.telemetry.latency import Path, Transport

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

    ``at_ms`` and ``ms`` are the newest samples as they came, of whatever span, at most 1,000, in time's order.
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
