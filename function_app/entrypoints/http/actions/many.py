"""One action on many devices."""

import asyncio

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem, invalid
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.actions.actions import Key, show_action
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, problem_item, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.actions.start_many import StartResult


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("actions")

    @routes.add(
        "POST /actions",
        "Start an action on many devices",
        {200: schemas.BatchActionOut, 202: schemas.BatchActionOut, 207: schemas.BatchActionOut},
        body=schemas.BatchActionRequest,
    )
    async def start_actions(request: Request, idempotency_key: Key = None) -> Response:
        """200: all actions have reached ``wait_for`` or have ended. 202: some have not. 207: some were rejected.

        The idempotency key applies to each device separately.
        """
        caller = await auth.account(request)
        payload: schemas.BatchActionRequest = await read(request, schemas.BatchActionRequest)
        if len(set(payload.devices)) != len(payload.devices):
            raise invalid("The list devices contains a device twice.")
        if not payload.epochs.keys() <= set(payload.devices):
            raise invalid("The field epochs contains a device that is not in devices.")
        requests = {device: payload.for_device(device) for device in payload.devices}
        results = await functions.start_many.start(caller, requests, idempotency_key=idempotency_key or "")
        items = await asyncio.gather(*(item(each) for each in results))
        rejected = any(isinstance(each.result, Problem) for each in results)
        reached = all(each.reached for each in results)
        return json_response(schemas.BatchActionOut(items=tuple(items)), 207 if rejected else 200 if reached else 202)

    async def item(start: StartResult) -> schemas.BatchActionItem:
        if isinstance(start.result, Problem):
            problem = problem_item(start.result)
            return schemas.BatchActionItem(device=start.device, status=problem.status, action=None, problem=problem)
        status = 200 if start.reached else 202
        return schemas.BatchActionItem(
            device=start.device, status=status, action=await show_action(functions, start.result), problem=None
        )

    return routes
