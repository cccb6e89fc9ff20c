"""MQTT packets are framed and parsed; the fuzzer tries random data."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.embedded_broker import packets
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.packets import Framer, MalformedPacket
from tests.harness.network import raw_mqtt

LIMITS = Limits()
TOPICS = st.text(st.characters(codec="utf-8"), min_size=1, max_size=100)


def framer() -> Framer:
    accepted = Framer(LIMITS)
    accepted.accept_all()
    return accepted


@given(TOPICS, st.binary(max_size=400), st.integers(0, 1), st.booleans(), st.integers(1, 0xFFFF))
def test_a_publish_round_trips(topic: str, payload: bytes, qos: int, retain: bool, packet_id: int) -> None:
    packet_id *= qos
    (frame,) = framer().feed(packets.publish(topic, payload, packet_id=packet_id, retain=retain))
    assert packets.read_publish(frame) == packets.Publish(topic, payload, qos, retain, packet_id)


@given(st.lists(st.binary(max_size=300), max_size=5), st.integers(1, 50))
def test_packets_do_not_depend_on_the_segmentation_of_the_stream(payloads: list[bytes], size: int) -> None:
    stream = b"".join(packets.publish("t", payload) for payload in payloads)
    cut, received = framer(), []
    for start in range(0, len(stream), size):
        received += [packets.read_publish(frame).payload for frame in cut.feed(stream[start : start + size])]
    assert received == payloads


def test_the_largest_publish_passes() -> None:
    topic, payload = "t" * LIMITS.topic_bytes, bytes(LIMITS.payload_bytes)
    assert len(list(framer().feed(packets.publish(topic, payload, packet_id=1)))) == 1


@pytest.mark.parametrize(
    ("cut", "data", "message"),
    [
        (framer(), b"\x30\xff\xff\x7f", "the maximum is"),
        (Framer(LIMITS), b"\x10\xff\xff\x7f", "the maximum is"),
        (Framer(LIMITS), raw_mqtt.PINGREQ, "unexpected packet"),
        (framer(), raw_mqtt.connect_packet("x"), "unexpected packet"),
    ],
)
def test_long_and_unexpected_packets_are_rejected_early(cut: Framer, data: bytes, message: str) -> None:
    with pytest.raises(MalformedPacket, match=message):
        list(cut.feed(data))


def test_an_inner_length_cannot_reach_into_the_next_packet() -> None:
    invalid = raw_mqtt.packet(3, b"\x00\x10ts")
    frames = framer().feed(invalid + raw_mqtt.publish_packet("secret/topic", b"x"))
    with pytest.raises(MalformedPacket, match="truncated"):
        packets.read_publish(next(frames))


@pytest.mark.parametrize("flags", [0b1, 0b1000, 0b10000, 0b11100, 0b11110100, 0b01000000])
def test_a_connect_with_invalid_flags_is_malformed(flags: int) -> None:
    with pytest.raises(MalformedPacket):
        packets.read_connect(raw_mqtt.text("MQTT") + bytes([4, flags]) + b"\0\0" + raw_mqtt.text("id"))


def test_a_connect_with_trailing_data_is_malformed() -> None:
    with pytest.raises(MalformedPacket, match="inconsistent"):
        packets.read_connect(raw_mqtt.connect_packet("x")[2:] + b"more")
