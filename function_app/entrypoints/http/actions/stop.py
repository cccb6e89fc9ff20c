"""``stop``: of a device, of a space, of all; and its reset."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, problem_type, read_or
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import Problem as Refusal
from function_app.services.actions.stop import StopResult


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("control")

    @routes.add(
        "POST",
        "/devices/{device}/stop",
        summary="Stop",
        body=schemas.StopRequest,
        body_required=False,
        answers={200: schemas.StopConfirmation},
        problems=(404,),
    )
    async def stop_device(request: Request, device: str) -> Response:
        """Needs no lease. Latches until it is reset."""
        who = await caller.account(request)
        asked = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return answer(schemas.StopConfirmation(confirmed=await functions.stop.stop(who, device, asked.reason)))

    @routes.add(
        "POST",
        "/devices/{device}/stop/reset",
        summary="Release the Stop latch",
        answers={200: schemas.StopConfirmation},
        problems=(404,),
    )
    async def reset_stop(request: Request, device: str) -> Response:
        """Nothing resumes: control must be taken again. One device at a time, by who has looked at it."""
        who = await caller.account(request)
        return answer(schemas.StopConfirmation(confirmed=await functions.stop.reset(who, device)))

    @routes.add(
        "POST",
        "/spaces/{space}/stop",
        summary="Stop everything in a space",
        body=schemas.StopRequest,
        body_required=False,
        answers={200: schemas.StopOut, 207: schemas.StopOut},
        problems=(404,),
    )
    async def stop_space(request: Request, space: str) -> Response:
        """200: all that one may operate have confirmed. 207: some have not; each says for itself."""
        who = await caller.account(request)
        asked = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return _all(await functions.stop.stop_many(who, asked.reason, space=space))

    @routes.add(
        "POST",
        "/stop",
        summary="Stop everything",
        body=schemas.StopRequest,
        body_required=False,
        answers={200: schemas.StopOut, 207: schemas.StopOut},
    )
    async def stop_all(request: Request) -> Response:
        """200: all that one may operate have confirmed. 207: some have not; each says for itself."""
        who = await caller.account(request)
        asked = await read_or(request, schemas.StopRequest, schemas.StopRequest())
        return _all(await functions.stop.stop_many(who, asked.reason))

    return routes


def _all(found: list[StopResult]) -> Response:
    items = tuple(_item(each) for each in found)
    return answer(schemas.StopOut(items=items), 200 if all(item.confirmed for item in items) else 207)


def _item(found: StopResult) -> schemas.StopItem:
    why = found.problem
    told = None
    if why is not None:
        told = Refusal(type=problem_type(why), title=why.title, status=why.status, detail=why.detail)
    return schemas.StopItem(
        device=found.device, status=why.status if why else 200, confirmed=found.confirmed, problem=told
    )
