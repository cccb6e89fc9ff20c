"""Delivery: QoS, order, deduplication, latency and retained messages."""

import statistics
import time

import paho.mqtt.client as paho
import pytest

from device_agent.protocol import codec
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Message, RunningBroker, Transport, wait_until
from tests.harness.network.raw_mqtt import RawConnection


@pytest.mark.parametrize(("said", "heard"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_message_arrives_at_the_lower_of_its_qos_and_the_subscriptions(
    broker: RunningBroker, space: str, transport: Transport, said: int, heard: int
) -> None:
    topic = f"ts/v1/{space}/arm/ur5/tele/joints"
    with (
        broker.client(f"{space}-arm", publish=(topic,), transport=transport) as arm,
        broker.client(f"{space}-page", subscribe=(topic,), transport=transport) as page,
    ):
        assert page.subscribe(topic, qos=heard) == [heard]
        arm.publish(topic, b"x", qos=said)
        assert page.receive() == Message(topic, b"x", min(said, heard), retain=False)


@pytest.mark.parametrize("qos", [0, 1])
def test_the_order_on_a_topic_is_kept(broker: RunningBroker, space: str, transport: Transport, qos: int) -> None:
    topic = f"ts/v1/{space}/arm/ur5/tele/joints"
    with (
        broker.client(f"{space}-arm", publish=(topic,), transport=transport) as arm,
        broker.client(f"{space}-page", subscribe=(topic,), transport=transport) as page,
    ):
        page.subscribe(topic, qos=qos)
        for number in range(400):
            arm.publish(topic, b"%d" % number, qos=qos)
        assert [int(page.receive().payload) for _ in range(400)] == list(range(400))


def test_a_message_arrives_once_though_two_filters_cover_it(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/ur5/state"
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-page", subscribe=(f"ts/v1/{space}/#",)) as page,
    ):
        page.subscribe(topic, f"ts/v1/{space}/arm/+/state", f"ts/v1/{space}/#")
        arm.publish_acknowledged(topic, b"1")
        arm.publish_acknowledged(topic, b"2")
        assert [page.receive().payload, page.receive().payload] == [b"1", b"2"]


def test_eight_filters_fit_into_one_subscribe(broker: RunningBroker, space: str) -> None:
    topics = [f"ts/v1/{space}/arm/ur5/{each}" for each in ("desc", "state", "event", "ack", "cmd", "stop")]
    topics += [f"ts/v1/{space}/arm/conn", f"ts/v1/{space}/arm/ur5/desc/twin"]
    with broker.client(space, publish=tuple(topics), subscribe=tuple(topics)) as client:
        assert client.subscribe(*topics) == [1] * 8
        for topic in topics:
            client.publish_acknowledged(topic, b"x")
        assert [client.receive().topic for _ in topics] == topics


def test_unsubscribe_stops_delivery(broker: RunningBroker, space: str) -> None:
    topic, other = f"ts/v1/{space}/arm/conn", f"ts/v1/{space}/other/conn"
    with broker.client(space, publish=(topic, other), subscribe=(topic, other)) as client:
        client.subscribe(topic, other)
        client.paho.unsubscribe(topic)
        client.publish_acknowledged(topic, b"x")
        client.publish_acknowledged(other, b"end")
        assert [m.topic for m in (client.receive(), *client.pending())] == [other]


def test_new_subscribers_get_retained_and_existing_ones_live_messages(
    broker: RunningBroker, space: str, transport: Transport
) -> None:
    topic = f"ts/v1/{space}/arm/ur5/state"
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-present", subscribe=(topic,), transport=transport) as present,
        broker.client(f"{space}-late", subscribe=(topic,), transport=transport) as late,
    ):
        present.subscribe(topic)
        arm.publish_acknowledged(topic, b"old", retain=True)
        arm.publish_acknowledged(topic, b"new", retain=True)
        assert [present.receive(), present.receive()] == [
            Message(topic, b"old", 1, retain=False),
            Message(topic, b"new", 1, retain=False),
        ]
        late.subscribe(topic)
        assert late.receive() == Message(topic, b"new", 1, retain=True)
        assert late.pending() == []


def test_an_empty_message_deletes_the_retained_one(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/ur5/state"
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-late", subscribe=(topic,)) as late,
    ):
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
        agents.publish_acknowledged(mine, b"mine", retain=True)
        agents.publish_acknowledged(others, b"others", retain=True)
        everything.subscribe(f"ts/v1/{space}/+/conn")
        assert {everything.receive().topic, everything.receive().topic} == {mine, others}
        with broker.client(f"{space}-new", subscribe=(mine,)) as new:
            new.subscribe(mine)
            assert new.receive().topic == mine
            agents.publish_acknowledged(mine, b"end")
            assert [m.payload for m in (new.receive(), *new.pending())] == [b"end"]
            assert [m.payload for m in (everything.receive(), *everything.pending())] == [b"end"]


def test_a_denied_publish_is_not_acknowledged(broker: RunningBroker, space: str) -> None:
    """With the broker's newest protocol; mosquitto acknowledges every publish of 3.1.1."""
    protocol = paho.MQTTv311 if broker.kind == "amqtt" else paho.MQTTv5
    allowed = f"ts/v1/{space}/arm/conn"
    with broker.client(space, publish=(allowed,), protocol=protocol) as client:
        refused = client.publish(f"ts/v1/{space}/other/conn", b"x")
        if broker.kind == "amqtt":
            wait_until(client.disconnected.is_set, "the end of the connection")
        else:
            client.publish_acknowledged(allowed, b"end")
        assert not client.acknowledged(refused)


def test_the_largest_message_of_the_contract_passes(broker: RunningBroker, space: str, transport: Transport) -> None:
    topic = f"ts/v1/{space}/arm/ur5/cam/wrist"
    with (
        broker.client(f"{space}-arm", publish=(topic,), transport=transport) as arm,
        broker.client(f"{space}-page", subscribe=(topic,), transport=transport) as page,
    ):
        page.subscribe(topic, qos=0)
        picture = bytes(range(256)) * (codec.MAX_BYTES // 256)
        arm.publish(topic, picture, qos=0)
        assert page.receive().payload == picture


@pytest.mark.parametrize("qos", [0, 1])
def test_an_oversized_message_is_rejected_without_side_effects(
    broker: RunningBroker, space: str, transport: Transport, qos: int
) -> None:
    topic = f"ts/v1/{space}/arm/ur5/cam/wrist"
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-page", subscribe=(topic,)) as page,
    ):
        page.subscribe(topic)
        with broker.client(f"{space}-huge", publish=(topic,), transport=transport) as huge:
            huge.publish(topic, b"x" * (codec.MAX_BYTES + 1_024), qos=qos)
            after = huge.publish(topic, b"after")
            wait_until(lambda: huge.disconnected.is_set() or huge.acknowledged(after), "the broker's answer")
            # Over WebSocket mosquitto 2.0 drops the message and goes on.
            assert huge.disconnected.is_set() or (broker.kind, transport) == ("mosquitto", "websockets")
        arm.publish_acknowledged(topic, b"small")
        heard = [page.receive().payload]
        while heard[-1] != b"small":
            heard.append(page.receive().payload)
        assert set(heard) <= {b"after", b"small"}


def test_small_messages_are_sent_without_delay(broker: RunningBroker, space: str, transport: Transport) -> None:
    """TCP_NODELAY on the broker's side: with Nagle's algorithm the second of two messages waits 40 ms.

    The listener has just been in conversation, as a client that acknowledges messages is: its kernel then delays its
    acknowledgements. A busy machine can slow one round down; without TCP_NODELAY no round could ever be quick.
    """
    topic = f"ts/v1/{space}/arm/ur5/tele/joints"
    credentials = broker.issue(broker.grant(space, subscribe=(topic,)))
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        RawConnection(broker.port(transport), transport) as listener,
    ):
        listener.send(raw_mqtt.connect_packet(space, credentials))
        assert listener.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
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
                # Not read before: reading would acknowledge the first, and Nagle's algorithm let the second go.
                assert listener.read() == (raw_mqtt.PUBLISH, 0, raw_mqtt.text(topic) + b"first")
                assert listener.read() == (raw_mqtt.PUBLISH, 0, raw_mqtt.text(topic) + b"second")
                gaps.append(time.perf_counter() - began)
            medians.append(statistics.median(gaps))
            if medians[-1] < NAGLE_S / 2:
                return
        raise AssertionError(f"medians of {medians} s between two messages")


NAGLE_S = 0.040
"""Linux's least delay of an acknowledgement [s]."""
CONVERSATION = 6
"""Exchanges after which Linux takes a connection for interactive; each acknowledgement that was delayed undoes it."""
