"""Delivery: QoS, order, deduplication, latency and retained messages."""

import contextlib
import statistics
import time
from collections.abc import Iterator

import paho.mqtt.client as paho
import pytest

from device_agent.protocol import codec
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Client, Message, RunningBroker, Transport, wait_until

NAGLE_S = 0.040
"""Minimum delay of an acknowledgement in Linux [s]."""
CONVERSATION = 6
"""Exchanges after which Linux considers a connection interactive; each delayed acknowledgement resets it."""


@contextlib.contextmanager
def arm_and_page(
    broker: RunningBroker, space: str, topic: str, transport: Transport = "tcp"
) -> Iterator[tuple[Client, Client]]:
    """A publisher and a subscriber of a topic."""
    with (
        broker.client(f"{space}-arm", publish=(topic,), transport=transport) as arm,
        broker.client(f"{space}-page", subscribe=(topic,), transport=transport) as page,
    ):
        yield arm, page


@pytest.fixture
def topic(space: str) -> str:
    return f"ts/v1/{space}/arm/ur5/state"


@pytest.mark.parametrize("qos", [0, 1])
def test_messages_arrive_in_order_at_the_lower_qos(
    broker: RunningBroker, space: str, topic: str, transport: Transport, qos: int
) -> None:
    with arm_and_page(broker, space, topic, transport) as (arm, page):
        for subscribed in (0, 1):
            assert page.subscribe(topic, qos=subscribed) == [subscribed]
            arm.publish(topic, b"x", qos=qos)
            assert page.receive() == Message(topic, b"x", min(qos, subscribed), retain=False)
        for number in range(400):
            arm.publish(topic, b"%d" % number, qos=qos)
        assert page.payloads(400) == [b"%d" % number for number in range(400)]


def test_a_message_arrives_once_if_several_filters_match_it(broker: RunningBroker, space: str, topic: str) -> None:
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-page", subscribe=(f"ts/v1/{space}/#",)) as page,
    ):
        page.subscribe(topic, f"ts/v1/{space}/arm/+/state", f"ts/v1/{space}/#")
        arm.publish_acknowledged(topic, b"1")
        arm.publish_acknowledged(topic, b"2")
        assert page.payloads(2) == [b"1", b"2"]


def test_a_subscribe_may_have_eight_filters_and_unsubscribe_stops_delivery(broker: RunningBroker, space: str) -> None:
    topics = [f"ts/v1/{space}/arm/ur5/{name}" for name in ("desc", "state", "event", "ack", "cmd", "stop")]
    topics += [f"ts/v1/{space}/arm/conn", f"ts/v1/{space}/arm/ur5/desc/twin"]
    with broker.client(space, publish=tuple(topics), subscribe=tuple(topics)) as client:
        assert client.subscribe(*topics) == [1] * 8
        for topic in topics:
            client.publish_acknowledged(topic, b"x")
        assert [client.receive().topic for _ in topics] == topics
        client.paho.unsubscribe(topics[0])
        client.publish_acknowledged(topics[0], b"x")
        client.publish_acknowledged(topics[1], b"end")
        assert [message.topic for message in (client.receive(), *client.pending())] == [topics[1]]


# ---------------------------------------------------------------- retained messages


def test_new_subscribers_get_retained_and_existing_ones_live_messages(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    with (
        arm_and_page(broker, space, topic, transport) as (arm, present),
        broker.client(f"{space}-late", subscribe=(topic,), transport=transport) as late,
    ):
        present.subscribe(topic)
        for payload in (b"old", b"new"):
            arm.publish_acknowledged(topic, payload, retain=True)
            assert present.receive() == Message(topic, payload, 1, retain=False)
        late.subscribe(topic)
        assert late.receive() == Message(topic, b"new", 1, retain=True)
        assert late.pending() == []


def test_an_empty_message_deletes_the_retained_one(broker: RunningBroker, space: str, topic: str) -> None:
    with arm_and_page(broker, space, topic) as (arm, late):
        arm.publish_acknowledged(topic, b"x", retain=True)
        arm.publish_acknowledged(topic, b"", retain=True)
        late.subscribe(topic)
        with pytest.raises(AssertionError, match="received nothing"):
            late.receive(SILENCE_S)


def test_retained_messages_go_to_the_new_subscription_only(broker: RunningBroker, space: str) -> None:
    """Regression: a new client received the retained messages of all clients' filters."""
    mine, others = f"ts/v1/{space}/mine/conn", f"ts/v1/{space}/others/conn"
    with (
        broker.client(f"{space}-agents", publish=(mine, others)) as agents,
        broker.client(f"{space}-all", subscribe=(f"ts/v1/{space}/+/conn",)) as everything,
    ):
        for topic in (mine, others):
            agents.publish_acknowledged(topic, topic, retain=True)
        everything.subscribe(f"ts/v1/{space}/+/conn")
        assert {everything.receive().topic, everything.receive().topic} == {mine, others}
        with broker.client(f"{space}-new", subscribe=(mine,)) as new:
            new.subscribe(mine)
            assert new.receive().topic == mine
            agents.publish_acknowledged(mine, b"end")
            for client in (new, everything):
                assert [message.payload for message in (client.receive(), *client.pending())] == [b"end"]


# ---------------------------------------------------------------- limits


def test_a_denied_publish_is_not_acknowledged(broker: RunningBroker, space: str) -> None:
    """With the broker's newest protocol; mosquitto acknowledges every publish of 3.1.1."""
    protocol = paho.MQTTv311 if broker.kind == "amqtt" else paho.MQTTv5
    allowed = f"ts/v1/{space}/arm/conn"
    with broker.client(space, publish=(allowed,), protocol=protocol) as client:
        refused = client.publish(f"ts/v1/{space}/other/conn", b"x")
        if broker.kind == "amqtt":
            assert client.ended()
        else:
            client.publish_acknowledged(allowed, b"end")
        assert not client.acknowledged(refused)


def test_the_largest_message_passes_and_a_larger_one_is_rejected_without_side_effects(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    largest = bytes(range(256)) * (codec.MAX_BYTES // 256)
    with arm_and_page(broker, space, topic, transport) as (arm, page):
        page.subscribe(topic)
        arm.publish_acknowledged(topic, largest)
        assert page.receive().payload == largest
        for qos in (0, 1):
            with broker.client(f"{space}-huge", publish=(topic,), transport=transport) as huge:
                huge.publish(topic, largest + bytes(1_024), qos=qos)
                after = huge.publish(topic, b"after")
                wait_until(lambda: huge.disconnected.is_set() or huge.acknowledged(after), "the response of the broker")  # noqa: B023 (called here)
                # Over WebSocket mosquitto 2.0 drops the message and continues.
                assert huge.disconnected.is_set() or (broker.kind, transport) == ("mosquitto", "websockets")
            arm.publish_acknowledged(topic, b"small")
            payloads = page.payloads(1)
            while payloads[-1] != b"small":
                payloads += page.payloads(1)
            assert set(payloads) <= {b"after", b"small"}


def test_small_messages_are_sent_without_delay(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    """TCP_NODELAY on the broker's side: with Nagle's algorithm the second of two messages waits 40 ms.

    The listener has just exchanged messages, as a client that acknowledges messages does: its kernel then delays its
    acknowledgements. A busy machine can slow one round down; without TCP_NODELAY no round could ever be quick.
    """
    credentials = broker.issue(broker.grant(space, subscribe=(topic,)))
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        raw_mqtt.open_session(broker, space, credentials, transport) as listener,
    ):
        listener.send(raw_mqtt.subscribe_packet(topic))
        assert listener.read() == (raw_mqtt.SUBACK, 0, b"\0\1\0")
        medians = []
        for _ in range(25):
            gaps = []
            for _ in range(9):
                for _ in range(CONVERSATION):
                    listener.send(raw_mqtt.PINGREQ)
                    assert listener.read() == (raw_mqtt.PINGRESP, 0, b"")
                arm.publish(topic, b"first", qos=0)
                time.sleep(0.003)  # so that the broker does not send both together
                began = time.perf_counter()
                arm.publish(topic, b"second", qos=0)
                # Do not read earlier: that would acknowledge the first message and release the second one.
                assert listener.read() == (raw_mqtt.PUBLISH, 0, raw_mqtt.text(topic) + b"first")
                assert listener.read() == (raw_mqtt.PUBLISH, 0, raw_mqtt.text(topic) + b"second")
                gaps.append(time.perf_counter() - began)
            medians.append(statistics.median(gaps))
            if medians[-1] < NAGLE_S / 2:
                return
        raise AssertionError(f"medians of {medians} s between two messages")
