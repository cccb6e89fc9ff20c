"""Latency samples and statistics."""

from typing import Annotated, Any

from fastapi import Header, Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.telemetry import schemas
from function_app.entrypoints.http.telemetry.uploads import own_device
from function_app.services.devices.device_access import require_operator
from function_app.services.telemetry.latency import LatencySeries, Path, Samples, Transport

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="Samples with the same key are stored once. Default: a hash of sender and samples.",
    ),
]
OfTransport = Annotated[Transport | None, Query(description="Only this transport.")]
OfPath = Annotated[Path | None, Query(description="Only this path.")]
Since = Annotated[
    int | None,
    Query(alias="from", ge=0, le=2**48, description="First time [ms since 1970]. Default: one day before `to`."),
]
Until = Annotated[int | None, Query(alias="to", ge=0, le=2**48, description="Last time [ms since 1970]. Default: now.")]
Recent = Annotated[int, Query(ge=0, le=1000, description="Maximum number of newest samples per item.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("latency")

    @routes.add(
        "POST /devices/{device}/latency", "Add latency samples of an operator", None, 404, body=schemas.LatencyRequest
    )
    async def add_latency(request: Request, device: str, idempotency_key: Key = None) -> Response:
        """Stores durations that a client measured with its own clock. Viewers are rejected."""
        caller = await auth.account(request)
        payload: schemas.LatencyRequest = await read(request, schemas.LatencyRequest)
        target = require_operator(await functions.devices.get(caller, device))
        sender = f"account:{caller.account}"
        await functions.latencies.add(target, _samples(payload), caller=sender, idempotency_key=idempotency_key or "")
        return empty()

    @routes.add(
        "POST /agents/{agent}/latency",
        "Add latency samples of an agent",
        None,
        404,
        body=schemas.AgentLatencyRequest,
        caller="agent",
    )
    async def add_agent_latency(request: Request, agent: str, idempotency_key: Key = None) -> Response:
        """Called by an agent. Stores durations that it measured for one of its devices with its own clock."""
        caller = await auth.agent(request)
        payload: schemas.AgentLatencyRequest = await read(request, schemas.AgentLatencyRequest)
        device = own_device(caller, agent, payload.device)
        sender = f"agent:{caller.id}"
        await functions.latencies.add(device, _samples(payload), caller=sender, idempotency_key=idempotency_key or "")
        return empty()

    @routes.add("GET /devices/{device}/latency", "Get latency statistics", schemas.LatencyList, (404, 422))
    async def get_latency(  # noqa: PLR0917 (FastAPI names them)
        request: Request,
        device: str,
        transport: OfTransport = None,
        path: OfPath = None,
        since: Since = None,
        until: Until = None,
        samples: Recent = 1000,
    ) -> Response:
        """Returns percentiles and histograms for each transport and path since the device was paired."""
        caller = await auth.account(request)
        target = await functions.devices.get(caller, device)
        span = functions.latencies.span(since, until)
        items = await functions.latencies.find(target, span, transport=transport, path=path)
        body = schemas.LatencyList(
            since=rfc3339(span.first_ms),
            until=rfc3339(span.last_ms),
            items=tuple(_latency_out(item, samples) for item in items),
        )
        return json_response(body)

    return routes


def _samples(payload: schemas.LatencyRequest | schemas.AgentLatencyRequest) -> Samples:
    return Samples(payload.transport, payload.path, tuple((sample.at_ms, sample.ms) for sample in payload.samples))


def _latency_out(series: LatencySeries, samples: int) -> schemas.LatencyOut:
    histogram = series.histogram
    recent = series.recent[len(series.recent) - min(samples, len(series.recent)) :]
    measures: dict[str, Any] = dict.fromkeys(
        ("mean_ms", "min_ms", "max_ms", "p50_ms", "p90_ms", "p95_ms", "p99_ms"), None
    )
    if histogram.count:
        measures = {"mean_ms": histogram.mean_ms, "min_ms": histogram.min_ms, "max_ms": histogram.max_ms}
        measures |= {f"p{percent}_ms": histogram.quantile(percent / 100) for percent in (50, 90, 95, 99)}
    return schemas.LatencyOut(
        transport=series.transport,
        path=series.path,
        count=histogram.count,
        bins=tuple(
            schemas.LatencyBin(above_ms=low, up_to_ms=high, count=count) for low, high, count in histogram.bins()
        ),
        at_ms=tuple(at_ms for at_ms, _ in recent),
        ms=tuple(ms for _, ms in recent),
        **measures,
    )
