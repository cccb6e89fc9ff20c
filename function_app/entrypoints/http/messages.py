"""``agents/{agent}/commands`` and ``agents/{agent}/messages``: for agents that cannot speak MQTT."""

from typing import Annotated

from fastapi import Query, Request, Response

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from function_app.bootstrap import Functions
from function_app.domain.devices import Agent
from function_app.domain.problems import not_found
from function_app.domain.times import rfc3339
from function_app.entrypoints.http.answers import answer, read
from function_app.entrypoints.http.caller import Caller
from function_app.entrypoints.http.contract import messages as contract
from function_app.entrypoints.http.routing import Routes
from function_app.entrypoints.ingest import take_in
from function_app.services.devices import require_claimed
from function_app.services.intake import Arrived

Wait = Annotated[int, Query(ge=0, le=30_000, description="Wait at most this long for a command [ms]; 0: plain poll.")]
Limit = Annotated[int, Query(ge=1, le=32, description="At most so many.")]
Have = Annotated[
    list[str], Query(max_length=32, description="Ids of commands that came already and are not answered yet.")
]
SAID = frozenset({topics.CONN, topics.DESC, topics.STATE, topics.EVENT, topics.ACK}) | topics.MEASURED
"""Classes of topics that agents speak on, and that are JSON."""


def router(functions: Functions, caller: Caller) -> Routes:
    """The routes."""
    routes = Routes("agents")

    @routes.add(
        "GET",
        "/agents/{agent}/commands",
        summary="Commands that wait for this agent",
        answers={200: contract.CommandList},
        problems=(404, 409, 422),
        caller="agent",
    )
    async def fetch_commands(
        request: Request,
        agent: str,
        wait_ms: Wait = 0,
        limit: Limit = 10,
        have: Have = (),  # type: ignore[assignment]
    ) -> Response:
        """Called by an agent that said ``http`` when it enrolled. A command comes again until an ack of it was told."""
        asking = await _asking(request, agent)
        found = await functions.polling.commands(asking, wait_ms=wait_ms, limit=limit, have=frozenset(have))
        items = tuple(
            contract.CommandOut(
                id=letter.command,
                topic=letter.topic,
                payload=letter.payload.decode(),
                expires_at=rfc3339(letter.expires_ms),
            )
            for letter in found
        )
        return answer(contract.CommandList(items=items), headers={"Cache-Control": "no-store"})

    @routes.add(
        "POST",
        "/agents/{agent}/messages",
        summary="What this agent has to say",
        body=contract.MessagesRequest,
        answers={200: contract.MessagesTaken},
        problems=(404, 409),
        caller="agent",
    )
    async def tell_messages(request: Request, agent: str) -> Response:
        """Acks, state, description, events, telemetry, as over MQTT; told to the broker's subscribers too.

        Each message has its own result. All may be told again: what was taken already changes nothing.
        """
        asking = await _asking(request, agent)
        space = require_claimed(asking)
        asked: contract.MessagesRequest = await read(request, contract.MessagesRequest)
        await functions.polling.seen(asking)  # first: what it says of itself counts more
        taken: dict[int, Arrived] = {}
        refused: dict[int, str] = {}
        for place, told in enumerate(asked.messages):
            try:
                arrived = Arrived(_own_topic(told.topic, space, asking), bytes(told.payload))
                if arrived.topic.kind not in topics.MEASURED:
                    await take_in(functions, arrived.topic, arrived.payload, by="http")
                taken[place] = arrived
            except ProtocolError as error:
                refused[place] = str(error)
        # All telemetry at once: that costs much less than one by one.
        measured = [place for place, arrived in taken.items() if arrived.topic.kind in topics.MEASURED]
        dropped = await functions.intake.take([taken[place] for place in measured])
        refused |= {measured[number]: why for number, why in dropped.items()}
        passed = [
            (asked.messages[place].topic, *arrived)
            for place, arrived in taken.items()
            if place not in refused and arrived.topic.kind != topics.LATE  # nobody looks at it as it comes
        ]
        await functions.relay.pass_on(passed)
        results = (
            contract.ToldOut(status="refused", detail=f"{refused[place].rstrip('.')}.")
            if place in refused
            else contract.ToldOut(status="stored")
            for place in range(len(asked.messages))
        )
        return answer(contract.MessagesTaken(results=tuple(results)))

    async def _asking(request: Request, agent: str) -> Agent:
        """The agent that asks, once it is seen that the path names it."""
        found = await caller.agent(request)
        if found.id != agent:
            raise not_found("agent", agent)
        return found

    return routes


def _own_topic(text: str, space: str, agent: Agent) -> Topic:
    """The topic, once it is seen that the agent may speak on it.

    Raises:
        ProtocolError: It may not.
    """
    topic = topics.parse(text)
    if (topic.space, topic.agent) != (space, agent.id) or (topic.device and agent.device(topic.device) is None):
        raise ProtocolError(f"'{text[:200]}' is not a topic of this agent or of a device that it has enrolled")
    if topic.kind not in SAID:
        raise ProtocolError(f"'{topic.kind}' is not for an agent to say here")
    return topic
