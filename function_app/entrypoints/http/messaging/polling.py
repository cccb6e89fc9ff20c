"""HTTP polling transport for agents without MQTT."""

from typing import Annotated

from fastapi import Query, Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.problems import not_found
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.devices.devices import Agent
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.entrypoints.http.messaging import schemas
from function_app.entrypoints.ingest.agent_messages import ingest_messages
from function_app.services.devices.device_access import require_claimed

Wait = Annotated[
    int, Query(ge=0, le=30_000, description="Maximum time to wait for a command [ms]; 0: return immediately.")
]
Limit = Annotated[int, Query(ge=1, le=32, description="Maximum number of commands.")]
Received = Annotated[
    list[str], Query(max_length=32, description="Ids of received commands that are not acknowledged yet.")
]


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("agents")

    @routes.add("GET /agents/{agent}/commands", "Poll commands", schemas.CommandList, (404, 409, 422), caller="agent")
    async def fetch_commands(
        request: Request,
        agent: str,
        wait_ms: Wait = 0,
        limit: Limit = 10,
        have: Received = (),  # type: ignore[assignment]
    ) -> Response:
        """For agents with transport ``http``. A command is returned until the agent acknowledges it."""
        caller = await _caller(request, agent)
        commands = await functions.polling.commands(caller, wait_ms=wait_ms, limit=limit, have=frozenset(have))
        items = tuple(
            schemas.CommandOut(
                id=command.command,
                topic=command.topic,
                payload=command.payload.decode(),
                expires_at=rfc3339(command.expires_ms),
            )
            for command in commands
        )
        return json_response(schemas.CommandList(items=items), headers={"Cache-Control": "no-store"})

    @routes.add(
        "POST /agents/{agent}/messages",
        "Post messages of an agent",
        schemas.MessageResults,
        (404, 409),
        body=schemas.MessagesRequest,
        caller="agent",
    )
    async def post_agent_messages(request: Request, agent: str) -> Response:
        """Accepts acks, state, description, events and telemetry as over MQTT, and publishes them to the broker.

        Each message has its own result. Safe to repeat: messages that are already stored have no effect.
        """
        caller = await _caller(request, agent)
        require_claimed(caller)
        payload: schemas.MessagesRequest = await read(request, schemas.MessagesRequest)
        await functions.polling.mark_online(caller)  # first: the posted presence takes precedence
        messages = [(each.topic, bytes(each.payload)) for each in payload.messages]
        results = (
            schemas.MessageResult(
                status="stored" if error is None else "rejected", detail=error and f"{error.rstrip('.')}."
            )
            for error in await ingest_messages(functions, caller, messages, by="http")
        )
        return json_response(schemas.MessageResults(results=tuple(results)))

    async def _caller(request: Request, agent: str) -> Agent:
        """The authenticated agent, which must be the agent of the path."""
        caller = await auth.agent(request)
        if caller.id != agent:
            raise not_found("agent", agent)
        return caller

    return routes
