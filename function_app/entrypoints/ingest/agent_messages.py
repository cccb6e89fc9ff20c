"""Messages that an agent sends without MQTT: checked, stored, and published to the broker's subscribers."""

from collections.abc import Sequence

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from function_app.bootstrap import Functions
from function_app.domain.devices.devices import Agent, Transport
from function_app.entrypoints.ingest.router import take_in
from function_app.services.devices.device_access import require_claimed
from function_app.services.telemetry.ingest import InboundMessage

SAID = frozenset({topics.CONN, topics.DESC, topics.STATE, topics.EVENT, topics.ACK}) | topics.MEASURED
"""Classes of topics that agents speak on, and that are JSON."""


async def tell(
    functions: Functions, agent: Agent, messages: Sequence[tuple[str, bytes]], *, by: Transport
) -> list[str | None]:
    """Take in messages of one agent, in order. Safe to repeat.

    Args:
        functions: Where to.
        agent: Who tells them.
        messages: Topics and payloads.
        by: How they came.

    Returns:
        For each message ``None``, or why it is refused: telling it again changes nothing.

    Raises:
        Problem, StoreError: Not all are stored; to be told again.
    """
    taken: dict[int, InboundMessage] = {}
    refused: dict[int, str] = {}
    for place, (topic, payload) in enumerate(messages):
        try:
            arrived = InboundMessage(own_topic(topic, agent), payload)
            if arrived.topic.kind not in topics.MEASURED:
                await take_in(functions, arrived.topic, arrived.payload, by=by)
            taken[place] = arrived
        except ProtocolError as error:
            refused[place] = str(error)
    # All telemetry at once: that costs much less than one by one.
    measured = [place for place, arrived in taken.items() if arrived.topic.kind in topics.MEASURED]
    dropped = await functions.telemetry_ingest.ingest([taken[place] for place in measured])
    refused |= {measured[number]: why for number, why in dropped.items()}
    passed = [
        (messages[place][0], *arrived)
        for place, arrived in taken.items()
        if place not in refused and arrived.topic.kind != topics.LATE  # late measurements have no live viewers
    ]
    await functions.relay.publish(passed)
    return [refused.get(place) for place in range(len(messages))]


def own_topic(text: str, agent: Agent) -> Topic:
    """The topic, once it is seen that the agent may speak on it.

    Raises:
        Problem: ``agent-unclaimed``.
        ProtocolError: It may not.
    """
    topic = topics.parse(text)
    mine = (require_claimed(agent), agent.id)
    if (topic.space, topic.agent) != mine or (topic.device and agent.device(topic.device) is None):
        raise ProtocolError(f"'{text[:200]}' is not a topic of this agent or of a device that it has enrolled")
    if topic.kind not in SAID:
        raise ProtocolError(f"'{topic.kind}' is not for an agent to say here")
    return topic
