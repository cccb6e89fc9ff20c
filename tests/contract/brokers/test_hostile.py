"""Hostile input of one connection affects neither the broker nor other clients.

The fixture checks after every test that the broker runs and has printed no traceback.
"""

import socket

from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import HOST, PATIENCE_S, RunningBroker, Transport
from tests.harness.network.raw_mqtt import RawConnection

GARBAGE = {
    "nothing": b"",
    "zeros": bytes(4_096),
    "ones": b"\xff" * 4_096,
    "text": b"GET /../../etc/passwd HTTP/1.1\r\nHost: x\r\n\r\n" * 20,
    "websocket handshake cut short": b"GET /mqtt HTTP/1.1\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\r\n",
    "tls": bytes.fromhex("16030100") + b"\x2f\x01\x00" * 40,
    "endless length": b"\x10\xff\xff\xff\xff\xff\x7f",
    "huge length": b"\x10\xff\xff\xff\x7f" + b"MQTT" * 1_000,
    "connect of nothing": b"\x10\x00",
    "connect with lying lengths": b"\x10\x10" + raw_mqtt.text("MQTT") + b"\x04\xc2\x00\x3c\xff\xff\xff\xff\xff\xff",
    "connect with broken text": raw_mqtt.packet(
        1, raw_mqtt.text("MQTT") + b"\x04\x02\x00\x3c" + raw_mqtt.text(b"\xc3\x28\xff\xfe")
    ),
    "connect of another protocol": raw_mqtt.packet(1, raw_mqtt.text("HTTP") + b"\x04\x02\x00\x3c" + raw_mqtt.text("x")),
    "publish first": raw_mqtt.publish_packet("ts/v1/a/b/conn", b"x"),
    "subscribe first": raw_mqtt.subscribe_packet("#"),
}
NOT_MQTT = {
    "publish that ends in its topic": raw_mqtt.packet(3, b"\xff\xffts/v1"),
    "publish without packet id": raw_mqtt.packet(3, raw_mqtt.text("ts/v1/a/b/conn"), flags=2),
    "publish at qos 3": raw_mqtt.packet(3, raw_mqtt.text("ts/v1/a/b/conn") + b"\0\1x", flags=6),
    "publish to nothing": raw_mqtt.publish_packet("", b"x"),
    "publish to broken text": raw_mqtt.publish_packet(b"ts/\xff\xfe/\xc3\x28", b"x"),
    "subscribe without filters": raw_mqtt.packet(8, b"\0\1", flags=2),
    "subscribe with wrong flags": raw_mqtt.packet(8, b"\0\1" + raw_mqtt.text("a") + b"\0", flags=0),
    "subscribe that ends in its filter": raw_mqtt.packet(8, b"\0\1\0\x40abc", flags=2),
    "subscribe at qos 3": raw_mqtt.packet(8, b"\0\1" + raw_mqtt.text("a") + b"\3", flags=2),
    "unsubscribe that ends in its filter": raw_mqtt.packet(10, b"\0\1\0\x40abc", flags=2),
    "connect again": raw_mqtt.connect_packet("again"),
    "packet of the broker": raw_mqtt.packet(2, b"\0\0"),
    "reserved packet": raw_mqtt.packet(15, b""),
    "garbage": b"\xff\xfe\xfd" * 100,
}


def test_garbage_before_connect_does_not_affect_others(broker: RunningBroker, space: str, transport: Transport) -> None:
    """Raw bytes on both listeners; the WebSocket listener receives non-HTTP data."""
    topic = f"ts/v1/{space}/arm/conn"
    with broker.client(space, publish=(topic,), subscribe=(topic,)) as client:
        client.subscribe(topic)
        for name, garbage in GARBAGE.items():
            with socket.create_connection((HOST, broker.port(transport)), PATIENCE_S) as raw:
                raw.sendall(garbage)
                client.publish_acknowledged(topic, b"during")
            client.publish_acknowledged(topic, b"after")
            assert client.payloads(2) == [b"during", b"after"], name


def test_garbage_in_websocket_frames_does_not_affect_others(broker: RunningBroker, space: str) -> None:
    with broker.client(space) as client:
        for name, garbage in GARBAGE.items():
            for sent in (garbage, garbage + garbage):
                with RawConnection(broker.websocket_port, "websockets") as raw:
                    raw.send(sent)
            assert client.subscribe("x") != [], name


def test_invalid_packets_close_their_connection_only(broker: RunningBroker, space: str, transport: Transport) -> None:
    credentials = broker.issue(broker.grant(space, publish=("ts/v1/#",), subscribe=("ts/v1/#",)))
    with broker.client(f"{space}-other") as other:
        for name, sent in NOT_MQTT.items():
            with raw_mqtt.open_session(broker, space, credentials, transport) as raw:
                raw.send(sent)
                assert raw.closed(), name
            assert not other.disconnected.is_set(), name
            assert other.subscribe("x") != []


def test_packets_may_arrive_in_single_bytes_or_in_one_segment(
    broker: RunningBroker, space: str, transport: Transport
) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    connect = raw_mqtt.connect_packet(space, credentials)
    with RawConnection(broker.port(transport), transport) as raw:
        for byte in connect:
            raw.send(bytes([byte]))
        assert raw.read() == raw_mqtt.ACCEPTED
    publish = raw_mqtt.publish_packet(topic, b"x", qos=1, packet_id=7)
    with RawConnection(broker.port(transport), transport) as raw:
        raw.send(connect + raw_mqtt.subscribe_packet(topic) + publish + raw_mqtt.PINGREQ)
        responses = [raw.read() for _ in range(5)]
        assert responses[:2] == [raw_mqtt.ACCEPTED, (raw_mqtt.SUBACK, 0, b"\0\1\0")]
        assert (raw_mqtt.PUBLISH, 0, raw_mqtt.text(topic) + b"x") in responses
        assert (raw_mqtt.PUBACK, 0, b"\0\7") in responses
        assert responses[-1] == (raw_mqtt.PINGRESP, 0, b"")


def test_a_blocked_subscriber_does_not_delay_others(broker: RunningBroker, space: str, transport: Transport) -> None:
    topic = f"ts/v1/{space}/arm/ur5/cam/wrist"
    credentials = broker.issue(broker.grant(f"{space}-stuck", subscribe=(topic,)))
    with (
        broker.client(f"{space}-arm", publish=(topic,)) as arm,
        broker.client(f"{space}-page", subscribe=(topic,)) as page,
        raw_mqtt.open_session(broker, f"{space}-stuck", credentials, transport) as stuck,
    ):
        stuck.send(raw_mqtt.subscribe_packet(topic))
        page.subscribe(topic)
        for _ in range(200):
            arm.publish_acknowledged(topic, bytes(100_000))
        assert {len(payload) for payload in page.payloads(200)} == {100_000}
