"""Stop of a device, a space or all devices, and its reset."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, problem_type, read_or
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import Problem as Refusal
from function_app.services.actions.stop import StopResult


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("control")

    @routes.add(
        "POST",
        "/devices/{device}/stop",
        summary="Stop a device",
        body=schemas.StopRequest,
        body_required=False,
        responses={200: schemas.StopConfirmation},
        problems=(404,),
    )
    async def stop_device(request: Request, device: str) -> Response:
        """Needs no lease. The Stop latches until it is reset."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return json_response(
            schemas.StopConfirmation(confirmed=await functions.stop.stop(caller, device, payload.reason))
        )

    @routes.add(
        "POST",
        "/devices/{device}/stop/reset",
        summary="Reset a Stop",
        responses={200: schemas.StopConfirmation},
        problems=(404,),
    )
    async def reset_stop(request: Request, device: str) -> Response:
        """Nothing resumes: control must be taken again. One device at a time, by a person who has inspected it."""
        caller = await auth.account(request)
        return json_response(schemas.StopConfirmation(confirmed=await functions.stop.reset(caller, device)))

    @routes.add(
        "POST",
        "/spaces/{space}/stop",
        summary="Stop all devices in a space",
        body=schemas.StopRequest,
        body_required=False,
        responses={200: schemas.StopOut, 207: schemas.StopOut},
        problems=(404,),
    )
    async def stop_space(request: Request, space: str) -> Response:
        """200: all devices that the caller may operate have confirmed. 207: some have not; each item has its status."""
        caller = await auth.account(request)
        payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return _all(await functions.stop.stop_many(caller, payload.reason, space=space))

    @routes.add(
        "POST",
        "/stop",
        summary="Stop all devices",
        body=schemas.StopRequest,
        body_required=False,
        responses={200: schemas.StopOut, 207: schemas.StopOut},
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
    why = found.problem
    told = None
    if why is not None:
        told = Refusal(type=problem_type(why), title=why.title, status=why.status, detail=why.detail)
    return schemas.StopItem(
        device=found.device, status=why.status if why else 200, confirmed=found.confirmed, problem=told
    )
