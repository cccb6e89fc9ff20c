"""Stop of a device, a space or all devices, and its reset."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, problem_item, read_or
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.actions.stop import StopResult


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("control")

    @routes.add(
        "POST /devices/{device}/stop", "Stop a device", schemas.StopConfirmation, 404, optional_body=schemas.StopRequest
    )
    async def stop_device(request: Request, device: str) -> Response:
        """Needs no lease. The Stop latches until it is reset."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return json_response(
            schemas.StopConfirmation(confirmed=await functions.stop.stop(caller, device, payload.reason))
        )

    @routes.add("POST /devices/{device}/stop/reset", "Reset a Stop", schemas.StopConfirmation, 404)
    async def reset_stop(request: Request, device: str) -> Response:
        """Nothing resumes: control must be taken again. One device at a time, by a person who has inspected it."""
        caller = await auth.account(request)
        return json_response(schemas.StopConfirmation(confirmed=await functions.stop.reset(caller, device)))

    @routes.add(
        "POST /spaces/{space}/stop",
        "Stop all devices in a space",
        {200: schemas.StopOut, 207: schemas.StopOut},
        404,
        optional_body=schemas.StopRequest,
    )
    async def stop_space(request: Request, space: str) -> Response:
        """200: all devices that the caller may operate have confirmed. 207: some have not; each item has its status."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return _all(await functions.stop.stop_many(caller, payload.reason, space=space))

    @routes.add(
        "POST /stop",
        "Stop all devices",
        {200: schemas.StopOut, 207: schemas.StopOut},
        optional_body=schemas.StopRequest,
    )
    async def stop_all(request: Request) -> Response:
        """200: all devices that the caller may operate have confirmed. 207: some have not; each item has its status."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return _all(await functions.stop.stop_many(caller, payload.reason))

    return routes


def _all(found: list[StopResult]) -> Response:
    items = tuple(_item(each) for each in found)
    return json_response(schemas.StopOut(items=items), 200 if all(item.confirmed for item in items) else 207)


def _item(found: StopResult) -> schemas.StopItem:
    refusal = None if found.problem is None else problem_item(found.problem)
    status = 200 if refusal is None else refusal.status
    return schemas.StopItem(device=found.device, status=status, confirmed=found.confirmed, problem=refusal)
