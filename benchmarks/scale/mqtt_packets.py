"""MQTT 3.1.1 as far as a generator of load needs it. A library's client would be what is measured.

Numbers are those of the standard, chapters 2 and 3.
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
_REFUSED: Final = 0x80
_MORE: Final = 0x80


def packet(kind: int, body: bytes) -> bytes:
    """With its length before it."""
    length, head = len(body), bytearray([kind])
    while True:
        length, low = divmod(length, _MORE)
        head.append(low | (_MORE if length else 0))
        if not length:
            return bytes(head) + body


def text(value: str) -> bytes:
    """With its length before it."""
    encoded = value.encode()
    return struct.pack("!H", len(encoded)) + encoded


def packets(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Those that are whole, as kind and body; they are taken from the buffer."""
    while len(buffer) > 1:
        length, shift, at = 0, 0, 1
        while at < len(buffer):
            length |= (buffer[at] & ~_MORE) << shift
            shift += 7
            at += 1
            if not buffer[at - 1] & _MORE:
                break
        else:
            return
        if len(buffer) < at + length:
            return
        kind, body = buffer[0], bytes(buffer[at : at + length])
        del buffer[: at + length]
        yield kind, body


def payload(body: bytes) -> bytes:
    """Of a PUBLISH at QoS 0."""
    return body[2 + int.from_bytes(body[:2]) :]


def connect(port: int, client: str, user: str, password: str) -> socket.socket:
    """A connection that the broker has taken. Raises: ConnectionError: It has not."""
    line = socket.create_connection((HOST, port), TIMEOUT_S)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    head = text("MQTT") + struct.pack("!BBH", 4, _CLEAN_WITH_LOGIN, _KEEP_ALIVE_S)
    line.sendall(packet(_CONNECT, head + text(client) + text(user) + text(password)))
    _expect(line, _CONNACK)
    return line


def subscribe(line: socket.socket, topic: str) -> None:
    """At QoS 0. Raises: ConnectionError: Refused."""
    line.sendall(packet(_SUBSCRIBE, struct.pack("!H", 1) + text(topic) + b"\0"))
    _expect(line, _SUBACK)


def _expect(line: socket.socket, wanted: int) -> None:
    """The broker's word, which ends with 0 for yes."""
    heard = bytearray()
    while True:
        came = line.recv(1024)
        if not came:
            raise ConnectionError("the broker has hung up")
        heard += came
        for kind, body in packets(heard):
            if kind == wanted and not body[-1]:
                return
            raise ConnectionError(f"the broker refuses: {kind:#x} {body!r}")
