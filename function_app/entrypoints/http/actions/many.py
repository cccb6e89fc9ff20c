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
    async def start_actions(request: Request, once: Key = None) -> Response:
        """200: all have reached ``wait_for`` or have ended. 202: some have not yet. 207: some were rejected.

        The idempotency key applies to each device separately.
        """
        caller = await auth.account(request)
        payload: schemas.BatchActionRequest = await read(request, schemas.BatchActionRequest)
        if len(set(payload.devices)) != len(payload.devices):
            raise invalid("A device is named twice.")
        if not payload.epochs.keys() <= set(payload.devices):
            raise invalid("epochs names a device that devices does not.")
        requests = {device: payload.for_device(device) for device in payload.devices}
        found = await functions.start_many.start(caller, requests, idempotency_key=once or "")
        items = await asyncio.gather(*(item(each) for each in found))
        refused = any(isinstance(each.result, Problem) for each in found)
        there = all(each.reached for each in found)
        return json_response(schemas.BatchActionOut(items=tuple(items)), 207 if refused else 200 if there else 202)

    async def item(found: StartResult) -> schemas.BatchActionItem:
        if isinstance(found.result, Problem):
            refusal = problem_item(found.result)
            return schemas.BatchActionItem(device=found.device, status=refusal.status, action=None, problem=refusal)
        status = 200 if found.reached else 202
        return schemas.BatchActionItem(
            device=found.device, status=status, action=await show_action(functions, found.result), problem=None
        )

    return routes
