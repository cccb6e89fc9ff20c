"""Actions of one device."""

from typing import Annotated, Literal

from fastapi import Header, Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.actions.action import Action
from function_app.entrypoints.http.actions import schemas
from function_app.entrypoints.http.actions.serializers import action_out
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read, require_empty
from function_app.entrypoints.http.framework.routing import PREFIX, Cursor, Limit, Routes
from function_app.entrypoints.http.framework.schemas import EmptyRequest
from function_app.services.actions.requests import ActionRequest

Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="Requests with the same key start one action.",
    ),
]
Wait = Annotated[int, Query(ge=0, le=30_000, description="Maximum time to wait [ms].")]
WaitFor = Annotated[Literal["started", "done"], Query(description="The status to wait for.")]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("actions")

    async def shown(action: Action) -> schemas.ActionOut:
        return await show_action(functions, action)

    @routes.add(
        "POST /devices/{device}/actions",
        "Start an action",
        {200: schemas.ActionOut, 202: schemas.ActionOut},
        (404, 409),
        body=ActionRequest,
    )
    async def start_action(request: Request, device: str, idempotency_key: Key = None) -> Response:
        """200: the action has reached ``wait_for`` or has ended. 202: it is queued or running; poll its URL."""
        caller = await auth.account(request)
        payload: ActionRequest = await read(request, ActionRequest)
        action, reached = await functions.start_action.start(
            caller, device, payload, idempotency_key=idempotency_key or ""
        )
        headers = {"Location": f"{PREFIX}/actions/{action.id}"}
        return json_response(await shown(action), 200 if reached else 202, headers)

    @routes.add("GET /devices/{device}/actions", "List actions of a device", schemas.ActionList, (404, 422))
    async def list_actions(request: Request, device: str, cursor: Cursor = None, limit: Limit = 100) -> Response:
        """Returns actions since the device was paired, newest first."""
        caller = await auth.account(request)
        found, next_cursor = await functions.actions.list(caller, device, cursor=cursor, limit=limit)
        positions = await functions.queues.positions(found)
        items = tuple(action_out(action, positions.get(action.id)) for action in found)
        return json_response(schemas.ActionList(items=items, cursor=next_cursor))

    @routes.add("GET /actions/{action}", "Get an action", schemas.ActionOut, (404, 422))
    async def get_action(request: Request, action: str, wait_ms: Wait = 0, wait_for: WaitFor = "done") -> Response:
        """Returns when the action has reached ``wait_for`` or has ended, or after ``wait_ms``."""
        caller = await auth.account(request)
        return json_response(
            await shown(await functions.actions.get(caller, action, wait_ms=wait_ms, wait_for=wait_for))
        )

    @routes.add(
        "POST /actions/{action}/cancel", "Cancel an action", {202: schemas.ActionOut}, 404, optional_body=EmptyRequest
    )
    async def cancel_action(request: Request, action: str) -> Response:
        """Sends a cancel command to the device. A queued action ends immediately. Poll the action for its end."""
        caller = await auth.account(request)
        await require_empty(request)
        return json_response(await shown(await functions.actions.cancel(caller, action)), 202)

    return routes


async def show_action(functions: Functions, action: Action) -> schemas.ActionOut:
    """An action with its position in the queue, if it is queued."""
    return action_out(action, (await functions.queues.positions([action])).get(action.id))
