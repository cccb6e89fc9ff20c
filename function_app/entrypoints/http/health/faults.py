"""Faults of a device."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, require_empty
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest
from function_app.entrypoints.http.health import schemas
from function_app.entrypoints.http.health.serializers import fault_out
from function_app.services.devices.device_access import require_operator

Open = Annotated[bool | None, Query(alias="open", description="true: only open faults; false: only cleared faults.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("diagnostics")

    @routes.add("GET /devices/{device}/faults", "List faults", schemas.FaultList, (404, 422))
    async def list_faults(
        request: Request, device: str, only: Open = None, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Returns faults since the device was paired. The first page has all open faults in addition to ``limit``."""
        caller = await auth.account(request)
        target = await functions.devices.get(caller, device)
        with_open, with_past = only is not False and cursor is None, only is not True
        current = await functions.faults.open(target) if with_open else []
        past, next_cursor = await functions.faults.past(target, cursor=cursor, limit=limit) if with_past else ([], None)
        return json_response(
            schemas.FaultList(items=tuple(fault_out(fault) for fault in (*current, *past)), cursor=next_cursor)
        )

    @routes.add(
        "POST /devices/{device}/faults/{fault}/acknowledge",
        "Acknowledge a fault",
        schemas.FaultOut,
        (404, 409),
        optional_body=EmptyRequest,
    )
    async def acknowledge_fault(request: Request, device: str, fault: str) -> Response:
        """The fault stays open until it is cleared. It records the first account that acknowledged it."""
        caller = await auth.account(request)
        target = require_operator(await functions.devices.get(caller, device))
        await require_empty(request)
        return json_response(fault_out(await functions.faults.acknowledge(target, fault, by=caller.name)))

    return routes
