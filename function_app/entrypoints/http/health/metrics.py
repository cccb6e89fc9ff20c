"""The metrics of this process and the state of the parts, for Prometheus."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable

from fastapi import Request, Response

from function_app import VERSION
from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem, unauthorized
from function_app.domain.health.server_health import Status
from function_app.entrypoints.http.framework.administration import has_metrics_token, is_local
from function_app.ports.monitoring import Gauge
from function_app.services.maintenance.readiness import Health

_CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
PATH = "/metrics"
_VALUES = {Status.OK: 1.0, Status.DEGRADED: 0.5, Status.FAILED: 0.0}


def endpoint(functions: Functions) -> Callable[[Request], Awaitable[Response]]:
    """The handler of ``PATH``."""

    async def metrics(request: Request) -> Response:
        """Requires the metrics token. Without such a setting, only programs on this machine may read it."""
        settings = functions.settings
        token = settings.administration.metrics_token
        local = not token and not settings.trusted_proxies and is_local(request)
        if not local and not has_metrics_token(request, settings.administration):
            raise unauthorized("Send the token in TELESCOPE_METRICS_TOKEN (Authorization: Bearer …).")
        exporter = functions.metrics
        health = await functions.health.check()
        sizes = await asyncio.to_thread(functions.adapters.stored_bytes)
        gauges = _gauges(health, sizes, functions.adapters.free_bytes(), functions.clock.now_ms())
        body = exporter.expose(gauges)
        if not body:
            raise Problem("metrics-missing", 404, "No metrics", "Install the Python package prometheus-client.")
        return Response(body, headers={"Content-Type": _CONTENT_TYPE, "Cache-Control": "no-store"})

    return metrics


def _gauges(health: Health, sizes: dict[str, int], free_bytes: int | None, now_ms: int) -> Iterable[Gauge]:
    yield "telescope_info", "Version of the server", "version", [(VERSION, 1)]
    parts = [(part.name, _VALUES[part.status]) for part in health.parts]
    yield "telescope_part_status", "State of a part: 1 ok, 0.5 degraded, 0 failed", "part", parts
    oldest = {
        name: (now_ms - max(beat.timers[name] for beat in health.workers if name in beat.timers)) / 1000
        for beat in health.workers
        for name in beat.timers
    }
    yield "telescope_timer_age_seconds", "Time since the last run of a timer", "timer", oldest.items()
    ages = [(now_ms - beat.seen_ms) / 1000 for beat in health.workers]
    yield "telescope_workers", "Workers with a heartbeat in the last ten minutes", "", [("", len(ages))]
    yield (
        "telescope_worker_age_seconds",
        "Time since the oldest heartbeat of a worker",
        "",
        [("", max(ages, default=0))],
    )
    yield (
        "telescope_ingest_lag_seconds",
        "Age of the oldest message that waits",
        "",
        [("", health.ingest_lag_ms / 1000)],
    )
    for name, count in (
        ("agents", max((beat.agents_online for beat in health.workers), default=0)),
        ("devices", max((beat.devices_online for beat in health.workers), default=0)),
    ):
        yield f"telescope_{name}_online", f"Connected {name}", "", [("", count)]
    yield "telescope_stored_bytes", "Size of the stores on this machine", "store", sizes.items()
    if free_bytes is not None:
        yield "telescope_disk_free_bytes", "Free disk space of the stores", "", [("", free_bytes)]
