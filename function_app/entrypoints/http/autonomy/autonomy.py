"""Sessions and autonomy of a device."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import LAST_MS, rfc3339
from function_app.domain.telemetry.sessions import Autonomy, Session
from function_app.entrypoints.http.autonomy import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes, Since, Until
from function_app.services.autonomy.autonomy_reader import AutonomyReport


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("autonomy")

    @routes.add("GET /devices/{device}/sessions", "List sessions", schemas.DeviceSessionList, (404, 422))
    async def device_sessions(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns who controlled the device since it was paired, newest first, and who moved it in each session."""
        caller = await auth.account(request)
        target = await functions.devices.get(caller, device)
        reports, next_cursor = await functions.autonomy.sessions(target, cursor=cursor, limit=limit)
        recorded = await functions.autonomy.recorded(target, reports)
        items = tuple(session_out(each, recorded=each.epoch in recorded) for each in reports)
        return json_response(schemas.DeviceSessionList(items=items, cursor=next_cursor))

    @routes.add("GET /devices/{device}/autonomy", "Get autonomy", schemas.AutonomyOut, (404, 422))
    async def get_autonomy(request: Request, device: str, since: Since = None, until: Until = None) -> Response:
        """Returns the shares of human and machine in the device's motion, in all, by day and by task.

        Sessions count with their start. Days are in UTC.
        """
        caller = await auth.account(request)
        target = await functions.devices.get(caller, device)
        last_ms = LAST_MS if until is None else until - 1
        report = await functions.autonomy.autonomy(target, first_ms=since or 0, last_ms=last_ms)
        return json_response(_autonomy(report))

    return routes


def session_out(session: Session, *, recorded: bool) -> schemas.DeviceSessionOut:
    """The response about a session."""
    return schemas.DeviceSessionOut(
        recorded=recorded,
        epoch=session.epoch,
        holder=session.holder or None,
        action=session.action or None,
        task=session.task or None,
        outcome=session.outcome or None,
        intervened=session.intervened,
        started_at=rfc3339(session.started_ms) if session.started_ms else None,
        ended_at=rfc3339(session.ended_ms) if session.ended_ms else None,
        start=session.start or None,
        end=session.end or None,
        first_input_s=session.first_input_s,
        share=_share(Autonomy(session.operator_s, session.machine_s)),
    )


def _autonomy(report: AutonomyReport) -> schemas.AutonomyOut:
    return schemas.AutonomyOut(
        share=_share(report.all),
        sessions=report.sessions,
        actions=report.actions,
        interventions=report.interventions,
        takeover_s=report.takeover_s,
        workload=report.workload,
        days=tuple(schemas.DayOut(at=rfc3339(day), share=_share(sums)) for day, sums in report.days.items()),
        tasks=tuple(schemas.TaskOut(name=name, share=_share(sums)) for name, sums in report.tasks.items()),
        complete=report.complete,
    )


def _share(sums: Autonomy) -> schemas.MotionShareOut:
    return schemas.MotionShareOut(
        operator_s=sums.operator_s, machine_s=sums.machine_s, hti=sums.hti, mti=sums.mti, mtia=sums.mtia
    )
