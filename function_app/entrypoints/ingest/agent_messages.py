"""Stores messages that an agent sends without MQTT, and publishes them to the broker's subscribers."""

from collections.abc import Sequence

from device_agent.protocol import topics
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.topics import Topic
from function_app.bootstrap import Functions
from function_app.domain.devices.devices import Agent, Transport
from function_app.entrypoints.ingest.router import store_message
from function_app.services.devices.device_access import require_claimed
from function_app.services.telemetry.ingest import InboundMessage

PUBLISHABLE = frozenset({topics.CONN, topics.DESC, topics.STATE, topics.EVENT, topics.ACK}) | topics.MEASURED
"""Topic classes with JSON payload on which agents publish."""


async def ingest_messages(
    functions: Functions, agent: Agent, messages: Sequence[tuple[str, bytes]], *, by: Transport
) -> list[str | None]:
    """Store and publish messages of one agent, in order. Safe to repeat.

    Args:
        functions: Services of the cloud.
        agent: The sender.
        messages: Topics and payloads.
        by: Transport of the messages.

    Returns:
        For each message ``None``, or the reason for its rejection, which is permanent.

    Raises:
        Problem, StoreError: At least one message is not stored; the agent must send all again.
    """
    accepted: dict[int, InboundMessage] = {}
    rejected: dict[int, str] = {}
    for index, (topic, payload) in enumerate(messages):
        try:
            message = InboundMessage(own_topic(topic, agent), payload)
            if message.topic.kind not in topics.MEASURED:
                await store_message(functions, message.topic, message.payload, by=by)
            accepted[index] = message
        except ProtocolError as error:
            rejected[index] = str(error)
    # One write for all telemetry is much cheaper than one for each message.
    telemetry = [index for index, message in accepted.items() if message.topic.kind in topics.MEASURED]
    dropped = await functions.telemetry_ingest.ingest([accepted[index] for index in telemetry])
    rejected |= {telemetry[number]: reason for number, reason in dropped.items()}
    published = [
        (messages[index][0], *message)
        for index, message in accepted.items()
        if index not in rejected and message.topic.kind != topics.LATE  # late measurements have no live viewers
    ]
    await functions.relay.publish(published)
    return [rejected.get(index) for index in range(len(messages))]


def own_topic(text: str, agent: Agent) -> Topic:
    """The parsed topic, on which the agent may publish.

    Raises:
        Problem: ``agent-unclaimed``.
        ProtocolError: The agent may not publish on this topic.
    """
    topic = topics.parse(text)
    own = (require_claimed(agent), agent.id)
    if (topic.space, topic.agent) != own or (topic.device and agent.device(topic.device) is None):
        raise ProtocolError(f"'{text[:200]}' is not a topic of this agent or of a device that it has enrolled")
    if topic.kind not in PUBLISHABLE:
        raise ProtocolError(f"an agent may not publish '{topic.kind}' with this transport")
    return topic
