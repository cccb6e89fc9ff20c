"""Stop of a device, a space or all devices, and its reset."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.text import clean_label
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, problem_item, read_or, require_empty
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest
from function_app.services.actions.stop import StopOutcome, StopResult

_MESSAGES = {
    StopOutcome.CONFIRMED: "The control loop of the device has applied the Stop.",
    StopOutcome.SENT: (
        "The Stop was sent, but the device has not confirmed it. It may still move. Use its emergency stop."
    ),
    StopOutcome.UNREACHABLE: "The device cannot be reached. It may still move. Use its emergency stop.",
}


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("control")

    @routes.add(
        "POST /devices/{device}/stop",
        "Stop a device",
        {200: schemas.StopItem, 202: schemas.StopItem},
        404,
        optional_body=schemas.StopRequest,
    )
    async def stop_device(request: Request, device: str) -> Response:
        """Requires no lease. The Stop stays latched until it is reset. Only status 200 means that it is confirmed.

        503 ``broker-unavailable``, with the outcome ``unreachable``: nothing could be sent.
        """
        caller = await auth.account(request)
        result = await functions.stop.stop(caller, device, await _reason(request))
        if result.problem is not None:
            result.problem.extras["outcome"] = result.outcome
            raise result.problem
        item = _item(result)
        return json_response(item, item.status)

    @routes.add(
        "POST /devices/{device}/stop/reset", "Reset a Stop", schemas.ResetConfirmation, 404, optional_body=EmptyRequest
    )
    async def reset_stop(request: Request, device: str) -> Response:
        """Motion does not resume; control must be acquired again.

        Only for one device, and only by a person, who must have inspected it. API keys are rejected.
        """
        caller = await auth.account(request)
        await require_empty(request)
        result = await functions.stop.reset(caller, device)
        rejection = result.reason
        reason = None if rejection is None else schemas.ReasonOut(code=rejection.code, message=rejection.message)
        return json_response(schemas.ResetConfirmation(confirmed=result.confirmed, reason=reason))

    @routes.add(
        "POST /spaces/{space}/stop",
        "Stop all devices in a space",
        {200: schemas.StopOut, 207: schemas.StopOut},
        404,
        optional_body=schemas.StopRequest,
    )
    async def stop_space(request: Request, space: str) -> Response:
        """Stops all devices that the caller may operate. 207: some have not confirmed; each item has its status."""
        caller = await auth.account(request)
        return _all(await functions.stop.stop_many(caller, await _reason(request), space=space))

    @routes.add(
        "POST /stop",
        "Stop all devices",
        {200: schemas.StopOut, 207: schemas.StopOut},
        optional_body=schemas.StopRequest,
    )
    async def stop_all(request: Request) -> Response:
        """Stops all devices that the caller may operate. 207: some have not confirmed; each item has its status."""
        caller = await auth.account(request)
        return _all(await functions.stop.stop_many(caller, await _reason(request)))

    return routes


async def _reason(request: Request) -> str:
    """The reason with spaces for characters that a label must not contain: they must not prevent a Stop."""
    payload = await read_or(request, schemas.StopRequest, schemas.StopRequest())
    return clean_label(payload.reason)


def _all(results: list[StopResult]) -> Response:
    items = tuple(_item(result) for result in results)
    return json_response(schemas.StopOut(items=items), 200 if all(item.confirmed for item in items) else 207)


def _item(result: StopResult) -> schemas.StopItem:
    problem = None if result.problem is None else problem_item(result.problem)
    confirmed = result.outcome is StopOutcome.CONFIRMED
    status = 200 if confirmed else 202 if problem is None else problem.status
    return schemas.StopItem(
        device=result.device,
        status=status,
        outcome=result.outcome,
        confirmed=confirmed,
        message=_MESSAGES[result.outcome],
        problem=problem,
    )
