"""Health of one device, a space or all devices."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.health.detectors import WINDOW_MS
from function_app.domain.health.diagnosis import Health, usual_range
from function_app.domain.health.faults import Severity
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.health import schemas
from function_app.entrypoints.http.health.serializers import fault_out
from function_app.services.health.diagnostics import FieldView, Summary


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("diagnostics")

    @routes.add("GET /devices/{device}/diagnostics", "Diagnose a device", schemas.DeviceDiagnostics, 404)
    async def get_diagnostics(request: Request, device: str) -> Response:
        """Returns open faults, and each measurement with its usual range, limits and trend."""
        caller = await auth.account(request)
        summary, fields = await functions.diagnostics.of_device(caller, device)
        body = schemas.DeviceDiagnostics(
            device=summary.view.device.id,
            label=summary.view.device.label,
            health=summary.health.value,
            online=summary.view.online,
            last_seen_at=_moment(summary.view.last_seen_ms),
            counts=_counts(summary),
            faults=tuple(fault_out(fault) for fault in summary.faults),
            fields=tuple(_field(field) for field in fields),
        )
        return json_response(body)

    @routes.add("GET /diagnostics", "Summarize the health of all devices", schemas.DeviceHealthList, 422)
    async def list_diagnostics(request: Request, cursor: Cursor = None, limit: Limit = 1000) -> Response:
        """Returns the health of each device, worst first, with counts."""
        caller = await auth.account(request)
        summaries, next_cursor = await functions.diagnostics.summaries(caller, space=None, cursor=cursor, limit=limit)
        return json_response(_list(summaries, next_cursor))

    @routes.add(
        "GET /spaces/{space}/diagnostics",
        "Summarize the health of a space's devices",
        schemas.DeviceHealthList,
        (404, 422),
    )
    async def list_space_diagnostics(
        request: Request, space: str, cursor: Cursor = None, limit: Limit = 1000
    ) -> Response:
        """Returns the health of each device, worst first, with counts."""
        caller = await auth.account(request)
        summaries, next_cursor = await functions.diagnostics.summaries(caller, space=space, cursor=cursor, limit=limit)
        return json_response(_list(summaries, next_cursor))

    return routes


def _list(summaries: list[Summary], cursor: str | None) -> schemas.DeviceHealthList:
    counted = {health.value: sum(summary.health is health for summary in summaries) for health in Health}
    items = tuple(
        schemas.DeviceHealthOut(
            device=summary.view.device.id,
            label=summary.view.device.label,
            space=summary.view.device.space,
            health=summary.health.value,
            online=summary.view.online,
            last_seen_at=_moment(summary.view.last_seen_ms),
            counts=_counts(summary),
            worst=fault_out(summary.faults[0]) if summary.faults else None,
        )
        for summary in summaries
    )
    return schemas.DeviceHealthList(counts=schemas.DeviceHealthCounts(**counted), items=items, cursor=cursor)


def _counts(summary: Summary) -> schemas.FaultCounts:
    return schemas.FaultCounts(**{severity.value: summary.count(severity) for severity in Severity})


def _field(view: FieldView) -> schemas.DiagnosticFieldOut:
    limits, watch = view.rule.limits, view.watch
    usual = usual_range(watch, limits)
    return schemas.DiagnosticFieldOut(
        stream=view.stream,
        field=view.name,
        label=view.rule.label,
        unit=view.rule.unit,
        advice=view.rule.advice,
        value=watch.value,
        baseline=watch.baseline.mean,
        usual_low=usual[0] if usual else None,
        usual_high=usual[1] if usual else None,
        warning_low=limits.warning_low,
        warning_high=limits.warning_high,
        low=limits.low,
        high=limits.high,
        slope_per_s=watch.slope_per_s,
        limit_earliest_s=None if watch.forecast is None else watch.forecast.earliest_s,
        limit_latest_s=None if watch.forecast is None else watch.forecast.latest_s,
        findings=watch.findings,
        updated_at=rfc3339(watch.seen_ms + WINDOW_MS),
    )


def _moment(at_ms: int | None) -> str | None:
    return None if at_ms is None else rfc3339(at_ms)
