"""Faults of a device."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.health import schemas
from function_app.entrypoints.http.health.serializers import fault_out
from function_app.services.devices.device_access import require_operator

Open = Annotated[bool | None, Query(alias="open", description="Only open ones, or only those that are over.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("diagnostics")

    @routes.add("GET /devices/{device}/faults", "List faults", schemas.FaultList, (404, 422))
    async def list_faults(
        request: Request, device: str, only: Open = None, cursor: Cursor = None, limit: Limit = 100
    ) -> Response:
        """Since the device was paired. The first page holds all open faults, which do not count towards ``limit``."""
        caller = await auth.account(request)
        found = await functions.devices.get(caller, device)
        with_open, with_past = only is not False and cursor is None, only is not True
        current = await functions.faults.open(found) if with_open else []
        past, following = await functions.faults.past(found, cursor=cursor, limit=limit) if with_past else ([], None)
        return json_response(
            schemas.FaultList(items=tuple(fault_out(fault) for fault in (*current, *past)), cursor=following)
        )

    @routes.add(
        "POST /devices/{device}/faults/{fault}/acknowledge", "Acknowledge a fault", schemas.FaultOut, (404, 409)
    )
    async def acknowledge_fault(request: Request, device: str, fault: str) -> Response:
        """It stays open until it is cleared. The first acknowledging account stays named."""
        caller = await auth.account(request)
        found = require_operator(await functions.devices.get(caller, device))
        return json_response(fault_out(await functions.faults.acknowledge(found, fault, by=caller.name)))

    return routes
