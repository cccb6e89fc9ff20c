"""``devices/{id}/actions`` and ``actions``."""

from typing import Annotated, Literal

from fastapi import Header, Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.actions.action import Action
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.actions.serializers import action_out
from function_app.entrypoints.http.framework.authentication import Caller
from function_app.entrypoints.http.framework.responses import answer, read
from function_app.entrypoints.http.framework.routing import PREFIX, Cursor, Limit, Routes
from function_app.services.actions.requests import ActionRequest

Key = Annotated[
    str | None,
    Header(alias="Idempotency-Key", min_length=1, max_length=200, description="The same key starts one action only."),
]
Wait = Annotated[int, Query(ge=0, le=30_000, description="Wait at most this long [ms].")]
WaitFor = Annotated[Literal["started", "done"], Query(description="What to wait for.")]


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("actions")

    async def shown(found: Action) -> schemas.ActionOut:
        return await show_action(functions, found)

    @routes.add(
        "POST",
        "/devices/{device}/actions",
        summary="Start an action",
        body=ActionRequest,
        answers={200: schemas.ActionOut, 202: schemas.ActionOut},
        problems=(404, 409),
    )
    async def start_action(request: Request, device: str, once: Key = None) -> Response:
        """200: it has come as far as ``wait_for``, or has ended. 202: it waits or is under way; ask at its address."""
        who = await caller.account(request)
        asked: ActionRequest = await read(request, ActionRequest)
        found, there = await functions.start_action.start(who, device, asked, idempotency_key=once or "")
        where = {"Location": f"{PREFIX}/actions/{found.id}"}
        return answer(await shown(found), 200 if there else 202, where)

    @routes.add(
        "GET",
        "/devices/{device}/actions",
        summary="A device's actions, newest first",
        answers={200: schemas.ActionList},
        problems=(404, 422),
    )
    async def list_actions(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Since it was paired."""
        who = await caller.account(request)
        found, following = await functions.actions.list(who, device, cursor=cursor, limit=limit)
        positions = await functions.queues.positions(found)
        items = tuple(action_out(each, positions.get(each.id)) for each in found)
        return answer(schemas.ActionList(items=items, cursor=following))

    @routes.add("GET", "/actions/{action}", summary="One action", answers={200: schemas.ActionOut}, problems=(404, 422))
    async def get_action(request: Request, action: str, wait_ms: Wait = 0, wait_for: WaitFor = "done") -> Response:
        """As soon as it has come as far as ``wait_for``, or as it is after ``wait_ms``."""
        who = await caller.account(request)
        return answer(await shown(await functions.actions.get(who, action, wait_ms=wait_ms, wait_for=wait_for)))

    @routes.add("POST", "/actions/{action}/cancel", summary="Cancel", answers={202: schemas.ActionOut}, problems=(404,))
    async def cancel_action(request: Request, action: str) -> Response:
        """Asks the device to end it; one that waits for its turn ends at once. It has ended when its status says so."""
        who = await caller.account(request)
        return answer(await shown(await functions.actions.cancel(who, action)), 202)

    return routes


async def show_action(functions: Functions, found: Action) -> schemas.ActionOut:
    """An action with its place in the queue, if it has one."""
    return action_out(found, (await functions.queues.positions([found])).get(found.id))
