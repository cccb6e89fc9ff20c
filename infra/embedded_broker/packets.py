"""MQTT 3.1.1 packets from and to bytes, without a socket.

A packet is cut from the stream by its length before it is parsed, so that an invalid inner length cannot affect the
next packet. amqtt's codec parses all packets except PUBLISH: for PUBLISH it accepts invalid UTF-8 and is slow.
"""

from collections.abc import Coroutine, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from amqtt.adapters import BufferReader
from amqtt.errors import AMQTTError, CodecError, MQTTError, NoDataError
from amqtt.mqtt.connack import ConnackPacket
from amqtt.mqtt.connect import ConnectPayload, ConnectVariableHeader
from amqtt.mqtt.packet import CONNECT, DISCONNECT, PINGREQ, PUBACK, PUBLISH, SUBSCRIBE, UNSUBSCRIBE, MQTTFixedHeader
from amqtt.mqtt.suback import SubackPacket
from amqtt.mqtt.subscribe import SubscribePacket
from amqtt.mqtt.unsuback import UnsubackPacket
from amqtt.mqtt.unsubscribe import UnsubscribePacket

from infra.embedded_broker.limits import Limits

T = TypeVar("T")

ACCEPTED, BAD_PROTOCOL, BAD_CLIENT_ID, UNAVAILABLE, NOT_AUTHORISED = 0, 1, 2, 3, 5
"""CONNACK return codes."""
REFUSED = 0x80
"""SUBACK return code of a rejected filter."""
PINGRESP = b"\xd0\x00"
MAX_QOS = 1
_HIGHEST_QOS = 2
"""Highest QoS of the specification; higher ones are malformed."""
_QOS_MASK = 0x06
_MAX_LENGTH_SHIFT = 21
_SHORT = 0x80
_SUBSCRIBE_FLAGS = 2
_EXACT_FLAGS = {SUBSCRIBE: _SUBSCRIBE_FLAGS, UNSUBSCRIBE: _SUBSCRIBE_FLAGS}


class MalformedPacket(Exception):  # noqa: N818 (the specification's term)
    """Invalid or unsupported bytes; the connection must be closed."""


class UnacceptableProtocol(Exception):  # noqa: N818 (the specification's term)
    """A CONNECT of an MQTT version other than 3.1.1."""


class Frame(NamedTuple):
    """One complete packet: type, flags, and the content after the fixed header."""

    kind: int
    flags: int
    body: bytes


class Will(NamedTuple):
    """The message to publish when a client disconnects unexpectedly."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class Connect(NamedTuple):
    """A CONNECT. Missing texts are empty; ``keep_alive_s`` 0 means none."""

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
    """Cuts packets from a byte stream. Accepts only CONNECT until ``accept_all``."""

    def __init__(self, limits: Limits) -> None:
        self._buffer = bytearray()
        self._limits = limits
        self._longest: Mapping[int, int] = {CONNECT: limits.connect_bytes}

    def accept_all(self) -> None:
        """Accept the packets of an admitted client, and no second CONNECT."""
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
        """All packets that are now complete.

        Raises:
            MalformedPacket: An unexpected, unsupported or too long packet; raised as soon as its first bytes show it.
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
            raise MalformedPacket(f"unexpected packet of type {kind}")
        if kind != PUBLISH and flags != _EXACT_FLAGS.get(kind, 0):
            raise MalformedPacket(f"invalid flags {flags} for packet type {kind}")
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
                raise MalformedPacket("length field longer than four bytes")
        if length > longest:
            raise MalformedPacket(f"packet of {length} bytes; the maximum is {longest}")
        if len(buffer) - at < length:
            return None
        frame = Frame(kind, flags, bytes(buffer[at : at + length]))
        del buffer[: at + length]
        return frame


def read_connect(body: bytes) -> Connect:
    """Parse a CONNECT.

    Raises:
        UnacceptableProtocol: Another MQTT version; detected before the parts that other versions encode differently.
        MalformedPacket: Not a valid CONNECT.
    """
    reader = BufferReader(body)
    header = _result_of(ConnectVariableHeader.from_stream(reader, None))
    if (header.proto_name, header.proto_level) != ("MQTT", 4):
        if header.proto_name in ("MQTT", "MQIsdp"):
            raise UnacceptableProtocol(f"MQTT level {header.proto_level}")
        raise MalformedPacket("CONNECT of another protocol")
    will_flags = header.will_qos or header.will_retain_flag
    if header.reserved_flag or (will_flags and not header.will_flag) or header.will_qos > _HIGHEST_QOS:
        raise MalformedPacket(f"flags {header.flags:#04x} in CONNECT")
    payload = _result_of(ConnectPayload.from_stream(reader, None, header))
    missing = (
        (header.will_flag and (payload.will_topic is None or payload.will_message is None))
        or (header.username_flag and payload.username is None)
        or (header.password_flag and payload.password is None)
    )
    if missing or _result_of(reader.read(1)):
        raise MalformedPacket("inconsistent fields in CONNECT")
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
    """Parse a PUBLISH.

    Raises:
        MalformedPacket: Too short, or the topic is not UTF-8.
    """
    body, flags = frame.body, frame.flags
    qos = (flags & _QOS_MASK) >> 1
    start = 2 + int.from_bytes(body[:2])
    packet_id = 0
    try:
        topic = body[2:start].decode()
    except UnicodeDecodeError as error:
        raise MalformedPacket("topic is not UTF-8") from error
    if qos:
        packet_id = int.from_bytes(body[start : start + 2])
        start += 2
        if not packet_id:
            raise MalformedPacket("PUBLISH without packet id")
    if start > len(body):
        raise MalformedPacket("truncated PUBLISH header")
    return Publish(topic, body[start:], qos, bool(flags & 1), packet_id)


def read_subscribe(frame: Frame) -> tuple[int, list[tuple[str, int]]]:
    """Packet id, and filters with the requested QoS.

    Raises:
        MalformedPacket: No filters, or invalid.
    """
    packet = _packet(SubscribePacket, frame)
    filters: list[tuple[str, int]] = list(packet.payload.topics)
    if _misread(frame, [text for text, _ in filters], 3) or any(qos > _HIGHEST_QOS for _, qos in filters):
        raise MalformedPacket("inconsistent fields in SUBSCRIBE")
    return packet.variable_header.packet_id, filters


def read_unsubscribe(frame: Frame) -> tuple[int, list[str]]:
    """Packet id and filters.

    Raises:
        MalformedPacket: No filters, or invalid.
    """
    packet = _packet(UnsubscribePacket, frame)
    filters: list[str] = list(packet.payload.topics)
    if _misread(frame, filters, 2):
        raise MalformedPacket("inconsistent fields in UNSUBSCRIBE")
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
    """The response to a CONNECT. No session is ever present: all sessions are clean."""
    return bytes(ConnackPacket.build(0, code).to_bytes())


def suback(packet_id: int, codes: list[int]) -> bytes:
    """The response to a SUBSCRIBE: a QoS or ``REFUSED`` for each filter."""
    return bytes(SubackPacket.build(packet_id, codes).to_bytes())


def unsuback(packet_id: int) -> bytes:
    """The response to an UNSUBSCRIBE."""
    return bytes(UnsubackPacket.build(packet_id).to_bytes())


def puback(packet_id: int) -> bytes:
    """The response to a PUBLISH at QoS 1."""
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
    return _result_of(kind.from_stream(BufferReader(frame.body), fixed_header=fixed))


def _misread(frame: Frame, filters: list[str], overhead: int) -> bool:
    """Whether the codec skipped or repaired something: a truncated filter, invalid UTF-8, no filters."""
    return not filters or 2 + sum(len(text.encode()) + overhead for text in filters) != len(frame.body)


def _result_of(coroutine: Coroutine[Any, Any, T]) -> T:
    """The result of a codec coroutine; it has all its data and therefore never waits."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    except (AMQTTError, CodecError, MQTTError, NoDataError, ValueError) as error:
        raise MalformedPacket(str(error) or type(error).__name__) from error
    coroutine.close()
    raise MalformedPacket("truncated packet")
