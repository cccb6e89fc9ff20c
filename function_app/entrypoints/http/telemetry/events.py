"""Events of a device."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response
from function_app.entrypoints.http.framework.routing import Cursor, Limit, Routes
from function_app.entrypoints.http.telemetry import schemas


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("diagnostics")

    @routes.add("GET /devices/{device}/events", "List events", schemas.EventList, (404, 422))
    async def list_events(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns control changes, rejected requests, faults and room events since the device was paired."""
        caller = await auth.account(request)
        target = await functions.devices.get(caller, device)
        events, next_cursor = await functions.events.read(target, cursor=cursor, limit=limit)
        items = tuple(
            schemas.EventOut(
                id=event["id"],
                kind=event["kind"],
                severity=event["severity"],
                message=event["message"],
                data=event["data"],
                at=rfc3339(event["at_ms"]),
                received_at=rfc3339(event["seen_ms"]),
            )
            for event in events
        )
        return json_response(schemas.EventList(items=items, cursor=next_cursor))

    return routes
