"""MQTT 3.1.1 packets for the load generator. A library's client would dominate the measurement.

Numbers come from chapters 2 and 3 of the standard.
"""

import socket
import struct
from collections.abc import Iterator
from typing import Final

from benchmarks.baseline.echo_servers import HOST
from benchmarks.baseline.product import TIMEOUT_S

_CONNECT, _CONNACK, PUBLISH, _SUBSCRIBE, _SUBACK = 0x10, 0x20, 0x30, 0x82, 0x90
_CLEAN_WITH_LOGIN: Final = 0xC2
_KEEP_ALIVE_S: Final = 3600
_CONTINUATION: Final = 0x80


def packet(kind: int, body: bytes) -> bytes:
    """Encodes a packet."""
    length, head = len(body), bytearray([kind])
    while True:
        length, low = divmod(length, _CONTINUATION)
        head.append(low | (_CONTINUATION if length else 0))
        if not length:
            return bytes(head) + body


def text(value: str) -> bytes:
    """Encodes a string with a length prefix."""
    encoded = value.encode()
    return struct.pack("!H", len(encoded)) + encoded


def packets(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Removes the complete packets from the buffer and yields their type and body."""
    while len(buffer) > 1:
        length, shift, at = 0, 0, 1
        while at < len(buffer):
            length |= (buffer[at] & ~_CONTINUATION) << shift
            shift += 7
            at += 1
            if not buffer[at - 1] & _CONTINUATION:
                break
        else:
            return
        if len(buffer) < at + length:
            return
        kind, body = buffer[0], bytes(buffer[at : at + length])
        del buffer[: at + length]
        yield kind, body


def payload(body: bytes) -> bytes:
    """Returns the payload of a PUBLISH with QoS 0."""
    return body[2 + int.from_bytes(body[:2]) :]


def connect(port: int, client: str, user: str, password: str) -> socket.socket:
    """Opens an accepted connection.

    Raises:
        ConnectionError: The broker rejected the connection.
    """
    connection = socket.create_connection((HOST, port), TIMEOUT_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    head = text("MQTT") + struct.pack("!BBH", 4, _CLEAN_WITH_LOGIN, _KEEP_ALIVE_S)
    connection.sendall(packet(_CONNECT, head + text(client) + text(user) + text(password)))
    _expect(connection, _CONNACK)
    return connection


def subscribe(connection: socket.socket, topic: str) -> None:
    """Subscribes with QoS 0.

    Raises:
        ConnectionError: The broker rejected the subscription.
    """
    connection.sendall(packet(_SUBSCRIBE, struct.pack("!H", 1) + text(topic) + b"\0"))
    _expect(connection, _SUBACK)


def _expect(connection: socket.socket, expected: int) -> None:
    """Reads the acknowledgement, which ends with 0 on success."""
    buffer = bytearray()
    while True:
        data = connection.recv(1024)
        if not data:
            raise ConnectionError("the broker closed the connection")
        buffer += data
        for kind, body in packets(buffer):
            if kind == expected and not body[-1]:
                return
            raise ConnectionError(f"the broker rejected the request: {kind:#x} {body!r}")
