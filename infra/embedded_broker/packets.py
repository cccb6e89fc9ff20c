"""MQTT 3.1.1 packets from and to bytes, without a socket.

A packet is cut out of the stream by its length first and read afterwards, so that a lying length field inside it can
never reach into the next one. What is not on the path of every message is read and written by amqtt's own codec;
PUBLISH is done here, because the codec lets text that is not UTF-8 pass and costs as much as all the rest together.
"""

from collections.abc import Coroutine, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from amqtt.adapters import BufferReader
from amqtt.errors import AMQTTError, CodecError, MQTTError, NoDataError
from amqtt.mqtt.connack import ConnackPacket
from amqtt.mqtt.connect import ConnectPayload, ConnectVariableHeader
from amqtt.mqtt.packet import (
    CONNECT,
    DISCONNECT,
    PINGREQ,
    PUBACK,
    PUBLISH,
    SUBSCRIBE,
    UNSUBSCRIBE,
    MQTTFixedHeader,
)
from amqtt.mqtt.suback import SubackPacket
from amqtt.mqtt.subscribe import SubscribePacket
from amqtt.mqtt.unsuback import UnsubackPacket
from amqtt.mqtt.unsubscribe import UnsubscribePacket

from infra.embedded_broker.limits import Limits

T = TypeVar("T")

ACCEPTED, BAD_PROTOCOL, BAD_CLIENT_ID, NOT_AUTHORISED = 0, 1, 2, 5
"""CONNACK return codes."""
REFUSED = 0x80
"""SUBACK return code of a filter that was not granted."""
PINGRESP = b"\xd0\x00"
MAX_QOS = 1
_QOS_MASK = 0x06
_MAX_LENGTH_SHIFT = 21
_SHORT = 0x80
_SUBSCRIBE_FLAGS = 2
_EXACT_FLAGS = {SUBSCRIBE: _SUBSCRIBE_FLAGS, UNSUBSCRIBE: _SUBSCRIBE_FLAGS}


class MalformedPacket(Exception):  # noqa: N818 (the specification's word)
    """Bytes that are not the MQTT that this broker speaks; the connection they came on has to end."""


class UnacceptableProtocol(Exception):  # noqa: N818 (the specification's word)
    """A CONNECT of another version of MQTT than 3.1.1."""


class Frame(NamedTuple):
    """One whole packet: its type, the flags beside it, and what follows the fixed header."""

    kind: int
    flags: int
    body: bytes


class Will(NamedTuple):
    """What a client leaves to be said when it vanishes."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class Connect(NamedTuple):
    """A CONNECT. Empty texts stand for what was not given; ``keep_alive_s`` 0 is none."""

    client_id: str
    username: str
    password: str
    keep_alive_s: int
    will: Will | None


class Publish(NamedTuple):
    """A PUBLISH from a client; ``packet_id`` is 0 at QoS 0."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    packet_id: int


class Framer:
    """Cuts packets out of a stream of bytes. Takes nothing but a CONNECT until ``open_up``."""

    def __init__(self, limits: Limits) -> None:
        self._buffer = bytearray()
        self._limits = limits
        self._longest: Mapping[int, int] = {CONNECT: limits.connect_bytes}

    def open_up(self) -> None:
        """From now on the packets of an accepted client pass, and no second CONNECT."""
        filters = 2 + self._limits.filters_per_subscribe * (self._limits.topic_bytes + 3)
        self._longest = {
            PUBLISH: self._limits.payload_bytes + self._limits.topic_bytes + 4,
            PUBACK: 2,
            SUBSCRIBE: filters,
            UNSUBSCRIBE: filters,
            PINGREQ: 0,
            DISCONNECT: 0,
        }

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Every packet that is now whole.

        Raises:
            MalformedPacket: A packet out of place, of a type that is not offered, or too long. Raised as soon as its
                first bytes say so, without waiting for the rest.
        """
        self._buffer += data
        while frame := self._next():
            yield frame

    def _next(self) -> Frame | None:
        buffer = self._buffer
        if not buffer:
            return None
        kind, flags = buffer[0] >> 4, buffer[0] & 0x0F
        longest = self._longest.get(kind)
        if longest is None:
            raise MalformedPacket(f"a packet of type {kind} has no place here")
        if kind != PUBLISH and flags != _EXACT_FLAGS.get(kind, 0):
            raise MalformedPacket(f"flags {flags} on a packet of type {kind}")
        length = shift = 0
        at = 1
        while True:
            if at == len(buffer):
                return None
            byte = buffer[at]
            at += 1
            length |= (byte & 0x7F) << shift
            if byte < _SHORT:
                break
            shift += 7
            if shift > _MAX_LENGTH_SHIFT:
                raise MalformedPacket("a length of more than four bytes")
        if length > longest:
            raise MalformedPacket(f"a packet of {length} bytes where {longest} is the most")
        if len(buffer) - at < length:
            return None
        frame = Frame(kind, flags, bytes(buffer[at : at + length]))
        del buffer[: at + length]
        return frame


def read_connect(body: bytes) -> Connect:
    """A CONNECT.

    Raises:
        UnacceptableProtocol: MQTT 5, 3.1, or whatever comes next; seen before the rest, which they write differently.
        MalformedPacket: Not a CONNECT.
    """
    reader = BufferReader(body)
    header = _now(ConnectVariableHeader.from_stream(reader, None))
    if (header.proto_name, header.proto_level) != ("MQTT", 4):
        if header.proto_name in ("MQTT", "MQIsdp"):
            raise UnacceptableProtocol(f"MQTT level {header.proto_level}")
        raise MalformedPacket("a CONNECT of another protocol")
    will_flags = header.will_qos or header.will_retain_flag
    if header.reserved_flag or (will_flags and not header.will_flag) or header.will_qos > MAX_QOS:
        raise MalformedPacket(f"flags {header.flags:#04x} in a CONNECT")
    payload = _now(ConnectPayload.from_stream(reader, None, header))
    missing = (
        (header.will_flag and (payload.will_topic is None or payload.will_message is None))
        or (header.username_flag and payload.username is None)
        or (header.password_flag and payload.password is None)
    )
    if missing or _now(reader.read(1)):
        raise MalformedPacket("a CONNECT whose fields do not add up")
    will = None
    if header.will_flag:
        will = Will(payload.will_topic, bytes(payload.will_message), header.will_qos, header.will_retain_flag)
    return Connect(
        client_id="" if payload.client_id_is_random else payload.client_id,
        username=payload.username or "",
        password=payload.password or "",
        keep_alive_s=header.keep_alive,
        will=will,
    )


def read_publish(frame: Frame) -> Publish:
    """A PUBLISH.

    Raises:
        MalformedPacket: Too short, or a topic that is not UTF-8.
    """
    body, flags = frame.body, frame.flags
    qos = (flags & _QOS_MASK) >> 1
    start = 2 + int.from_bytes(body[:2])
    packet_id = 0
    try:
        topic = body[2:start].decode()
    except UnicodeDecodeError as error:
        raise MalformedPacket("a topic that is not UTF-8") from error
    if qos:
        packet_id = int.from_bytes(body[start : start + 2])
        start += 2
        if not packet_id:
            raise MalformedPacket("a PUBLISH without its packet id")
    if start > len(body):
        raise MalformedPacket("a PUBLISH that ends inside its header")
    return Publish(topic, body[start:], qos, bool(flags & 1), packet_id)


def read_subscribe(frame: Frame) -> tuple[int, list[tuple[str, int]]]:
    """Packet id, and filters with the QoS asked for.

    Raises:
        MalformedPacket: None, or not to be read.
    """
    packet = _packet(SubscribePacket, frame)
    filters: list[tuple[str, int]] = list(packet.payload.topics)
    if _misread(frame, [text for text, _ in filters], 3) or any(qos > MAX_QOS + 1 for _, qos in filters):
        raise MalformedPacket("a SUBSCRIBE whose fields do not add up")
    return packet.variable_header.packet_id, filters


def read_unsubscribe(frame: Frame) -> tuple[int, list[str]]:
    """Packet id and filters.

    Raises:
        MalformedPacket: None, or not to be read.
    """
    packet = _packet(UnsubscribePacket, frame)
    filters: list[str] = list(packet.payload.topics)
    if _misread(frame, filters, 2):
        raise MalformedPacket("an UNSUBSCRIBE whose fields do not add up")
    return packet.variable_header.packet_id, filters


def read_puback(frame: Frame) -> int:
    """Packet id.

    Raises:
        MalformedPacket: Too short.
    """
    if len(frame.body) != 2:  # noqa: PLR2004 (a packet id is two bytes)
        raise MalformedPacket("a PUBACK without its packet id")
    return int.from_bytes(frame.body)


def connack(code: int) -> bytes:
    """The answer to a CONNECT. There never is a session from before: all are clean."""
    return bytes(ConnackPacket.build(0, code).to_bytes())


def suback(packet_id: int, codes: list[int]) -> bytes:
    """The answer to a SUBSCRIBE: a QoS or ``REFUSED`` for each filter."""
    return bytes(SubackPacket.build(packet_id, codes).to_bytes())


def unsuback(packet_id: int) -> bytes:
    """The answer to an UNSUBSCRIBE."""
    return bytes(UnsubackPacket.build(packet_id).to_bytes())


def puback(packet_id: int) -> bytes:
    """The answer to a PUBLISH at QoS 1."""
    return b"\x40\x02" + packet_id.to_bytes(2)


def publish(topic: str, payload: bytes, *, packet_id: int = 0, retain: bool = False) -> bytes:
    """A PUBLISH to a client: QoS 1 with a packet id, QoS 0 without."""
    name = topic.encode()
    length = 2 + len(name) + len(payload) + (2 if packet_id else 0)
    packet = bytearray((0x30 | (_QOS_MASK & 2 if packet_id else 0) | retain,))
    while length >= _SHORT:
        packet.append(length & 0x7F | _SHORT)
        length >>= 7
    packet.append(length)
    packet += len(name).to_bytes(2)
    packet += name
    if packet_id:
        packet += packet_id.to_bytes(2)
    packet += payload
    return bytes(packet)


def _packet(kind: Any, frame: Frame) -> Any:
    fixed = MQTTFixedHeader(frame.kind, frame.flags, len(frame.body))
    return _now(kind.from_stream(BufferReader(frame.body), fixed_header=fixed))


def _misread(frame: Frame, filters: list[str], overhead: int) -> bool:
    """Whether the codec has skipped or mended something: a cut-off filter, text that is not UTF-8, no filter at all."""
    return not filters or 2 + sum(len(text.encode()) + overhead for text in filters) != len(frame.body)


def _now(reading: Coroutine[Any, Any, T]) -> T:
    """The result of one of the codec's coroutines, which has all its bytes and therefore never waits."""
    try:
        reading.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    except (AMQTTError, CodecError, MQTTError, NoDataError, ValueError) as error:
        raise MalformedPacket(str(error) or type(error).__name__) from error
    reading.close()
    raise MalformedPacket("a packet that ends inside a field")
