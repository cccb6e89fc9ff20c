"""``actions``: one action, many devices."""

import asyncio

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem, invalid
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.actions.actions import Key, show_action
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, problem_type, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.framework.schemas import Problem as Refusal
from function_app.services.actions.start_many import StartResult


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("actions")

    @routes.add(
        "POST",
        "/actions",
        summary="Start an action on many devices",
        body=schemas.BatchActionRequest,
        answers={200: schemas.BatchActionOut, 202: schemas.BatchActionOut, 207: schemas.BatchActionOut},
    )
    async def start_actions(request: Request, once: Key = None) -> Response:
        """200: all have come as far as ``wait_for``, or have ended. 202: some are not there yet. 207: some are refused.

        The key counts for each device by itself.
        """
        who = await caller.account(request)
        asked: schemas.BatchActionRequest = await read(request, schemas.BatchActionRequest)
        if len(set(asked.devices)) != len(asked.devices):
            raise invalid("A device is named twice.")
        if not asked.epochs.keys() <= set(asked.devices):
            raise invalid("epochs names a device that devices does not.")
        requests = {device: asked.for_device(device) for device in asked.devices}
        found = await functions.start_many.start(who, requests, idempotency_key=once or "")
        items = await asyncio.gather(*(item(each) for each in found))
        refused = any(isinstance(each.result, Problem) for each in found)
        there = all(each.reached for each in found)
        return answer(schemas.BatchActionOut(items=tuple(items)), 207 if refused else 200 if there else 202)

    async def item(found: StartResult) -> schemas.BatchActionItem:
        if isinstance(found.result, Problem):
            why = found.result
            told = Refusal(type=problem_type(why), title=why.title, status=why.status, detail=why.detail)
            return schemas.BatchActionItem(device=found.device, status=why.status, action=None, problem=told)
        status = 200 if found.reached else 202
        return schemas.BatchActionItem(
            device=found.device, status=status, action=await show_action(functions, found.result), problem=None
        )

    return routes
