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
from function_app.entrypoints.ingest.agent_messages import tell
from function_app.services.devices.device_access import require_claimed

Wait = Annotated[int, Query(ge=0, le=30_000, description="Wait at most this long for a command [ms]; 0: plain poll.")]
Limit = Annotated[int, Query(ge=1, le=32, description="At most so many.")]
Have = Annotated[
    list[str], Query(max_length=32, description="Ids of commands that came already and are not answered yet.")
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
        have: Have = (),  # type: ignore[assignment]
    ) -> Response:
        """For agents enrolled with transport ``http``. A command is returned until the agent posts an ack of it."""
        asking = await _asking(request, agent)
        found = await functions.polling.commands(asking, wait_ms=wait_ms, limit=limit, have=frozenset(have))
        items = tuple(
            schemas.CommandOut(
                id=letter.command,
                topic=letter.topic,
                payload=letter.payload.decode(),
                expires_at=rfc3339(letter.expires_ms),
            )
            for letter in found
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
        """Acks, state, description, events and telemetry as over MQTT. The broker's subscribers receive them too.

        Each message has its own result. Messages may be sent again: stored ones change nothing.
        """
        asking = await _asking(request, agent)
        require_claimed(asking)
        payload: schemas.MessagesRequest = await read(request, schemas.MessagesRequest)
        await functions.polling.mark_online(asking)  # first: what it says of itself counts more
        told = [(each.topic, bytes(each.payload)) for each in payload.messages]
        results = (
            schemas.MessageResult(status="stored" if why is None else "rejected", detail=why and f"{why.rstrip('.')}.")
            for why in await tell(functions, asking, told, by="http")
        )
        return json_response(schemas.MessageResults(results=tuple(results)))

    async def _asking(request: Request, agent: str) -> Agent:
        """The agent that asks, once it is seen that the path names it."""
        found = await auth.agent(request)
        if found.id != agent:
            raise not_found("agent", agent)
        return found

    return routes
