"""Stored messages are confirmed to their agent, by the digest of their topic and payload."""

import asyncio

import pytest

from device_agent.protocol import AckStatus, Stored, codec, topics
from device_agent.protocol.acks import MAX_IDS, message_id
from device_agent.protocol.security import grants
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.network.brokers import Client


@pytest.fixture
def confirmed(robot: Robot) -> Client:
    """The robot's connection, subscribed to its confirmations."""
    assert robot.link is not None
    robot.link.subscribe(grants.agent_confirmations(robot.space, robot.id))
    robot.link.messages.queue.clear()
    return robot.link


def stored_ids(client: Client) -> dict[str, list[str]]:
    """Topic → ids of all confirmations."""
    found: dict[str, list[str]] = {}
    for message in client.pending():
        if message.topic.endswith("/stored"):
            assert (message.qos, message.retain) == (0, False)
            found.setdefault(message.topic, []).extend(codec.decode(message.payload, Stored).ids)
    return found


def test_an_ack_is_confirmed_after_it_is_stored(anna: Person, robot: Robot, confirmed: Client) -> None:
    action = anna.start(robot.device).json()["id"]
    stored_ids(confirmed)
    ack = robot.report(action, AckStatus.DONE)
    assert anna.action(action)["status"] == "done"
    topic = robot.topic(topics.ACK)
    assert stored_ids(confirmed) == {robot.topic(topics.STORED): [message_id(topic, codec.encode(ack))]}


@pytest.mark.parametrize(
    ("place", "payload"),
    [
        ((topics.ACK, ""), b"{"),
        ((topics.ACK, ""), b'{"id":"a-b-0","status":"done","sequence":1,"at_ms":1,"tick_ms":1}'),
        ((topics.EVENT, ""), b"[]"),
        ((topics.LATE, "joints"), b"{}"),
    ],
)
def test_a_message_that_will_never_be_accepted_is_confirmed(
    cloud: Cloud, robot: Robot, confirmed: Client, place: tuple[str, str], payload: bytes
) -> None:
    cloud.start_late()
    topic = topics.device(robot.space, robot.id, "arm", *place)
    confirmed.publish_acknowledged(topic, payload)
    cloud.run(asyncio.sleep(2))
    assert stored_ids(confirmed) == {robot.topic(topics.STORED): [message_id(topic, payload)]}


def test_states_and_invalid_topics_are_not_confirmed(cloud: Cloud, robot: Robot, confirmed: Client) -> None:
    ack = (robot.topic(topics.ACK), b"{}")
    others = [("no/topic", b"{}"), (robot.topic(topics.STATE), b"{}"), (robot.topic(topics.STORED), b"{}")]
    cloud.run(cloud.functions.confirmations.publish([*others, ack]))
    assert stored_ids(confirmed) == {robot.topic(topics.STORED): [message_id(*ack)]}


def test_a_batch_is_confirmed_in_few_messages_of_bounded_size(cloud: Cloud, robot: Robot, confirmed: Client) -> None:
    late = topics.device(robot.space, robot.id, "arm", topics.LATE, "joints")
    messages = [(late, b"%d" % number) for number in range(MAX_IDS + 1)]
    cloud.run(cloud.functions.confirmations.publish(messages))
    sizes = [len(codec.decode(message.payload, Stored).ids) for message in confirmed.pending()]
    assert sizes == [MAX_IDS, 1]
    cloud.run(cloud.functions.confirmations.publish(messages))
    assert stored_ids(confirmed) == {robot.topic(topics.STORED): [message_id(*message) for message in messages]}


def test_without_a_broker_nothing_is_confirmed(cloud: Cloud, robot: Robot, broker: MemoryBroker) -> None:
    broker.reachable = False
    cloud.run(cloud.functions.confirmations.publish([(robot.topic(topics.ACK), b"{}")]))


def test_confirmations_continue_when_the_clock_is_set_back(
    cloud: Cloud, robot: Robot, broker: MemoryBroker, confirmed: Client
) -> None:
    message = (robot.topic(topics.ACK), b"{}")
    broker.reachable = False
    cloud.run(cloud.functions.confirmations.publish([message]))
    broker.reachable = True
    cloud.clock.advance(-3600)
    cloud.run(cloud.functions.confirmations.publish([message]))
    assert stored_ids(confirmed) == {robot.topic(topics.STORED): [message_id(*message)]}
