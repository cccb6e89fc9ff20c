"""Raw MQTT over TCP or WebSocket, for behaviour that client libraries hide."""

import contextlib
import socket
from typing import Any, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from function_app.ports.broker_access import Credentials
from tests.harness.network.brokers import HOST, PATIENCE_S, RunningBroker, Transport

CONNACK, PUBLISH, PUBACK, SUBACK, PINGRESP = 2, 3, 4, 9, 13
PINGREQ = b"\xc0\x00"
ACCEPTED = (CONNACK, 0, b"\0\0")
"""The response to a CONNECT that is accepted, without an earlier session."""


def text(value: str | bytes) -> bytes:
    raw = value.encode() if isinstance(value, str) else value
    return len(raw).to_bytes(2) + raw


def packet(kind: int, body: bytes, flags: int = 0) -> bytes:
    length, sized = len(body), bytearray()
    while True:
        length, low = length >> 7, length & 0x7F
        sized.append(low | (0x80 if length else 0))
        if not length:
            return bytes([kind << 4 | flags]) + bytes(sized) + body


def connect_packet(
    client_id: str,
    credentials: Credentials | None = None,
    *,
    keep_alive_s: int = 60,
    level: int = 4,
    clean: bool = True,
) -> bytes:
    flags = (0xC0 if credentials else 0) | (2 if clean else 0)
    body = text("MQTT") + bytes([level, flags]) + keep_alive_s.to_bytes(2)
    body += b"\0" if level == 5 else b""  # no properties
    body += text(client_id) + b"".join(text(each) for each in credentials or ())
    return packet(1, body)


def connect_with_will(
    client_id: str, credentials: Credentials, topic: str, payload: bytes, *, keep_alive_s: int
) -> bytes:
    body = text("MQTT") + bytes([4, 0xC0 | 0x06 | 0x08]) + keep_alive_s.to_bytes(2)
    return packet(
        1, body + text(client_id) + text(topic) + text(payload) + b"".join(text(each) for each in credentials)
    )


def publish_packet(
    topic: str | bytes, payload: bytes, *, qos: int = 0, packet_id: int = 1, retain: bool = False
) -> bytes:
    body = text(topic) + (packet_id.to_bytes(2) if qos else b"") + payload
    return packet(3, body, qos << 1 | retain)


def subscribe_packet(*filters: str, qos: int = 0, packet_id: int = 1) -> bytes:
    return packet(8, packet_id.to_bytes(2) + b"".join(text(each) + bytes([qos]) for each in filters), 2)


class RawConnection:
    """One connection; ``read`` returns complete packets, and ``None`` after the broker has closed it."""

    def __init__(self, port: int, transport: Transport = "tcp") -> None:
        self._buffer = bytearray()
        self._websocket: ClientConnection | None = None
        self._socket = socket.create_connection((HOST, port), PATIENCE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if transport == "websockets":
            self._websocket = connect(
                f"ws://{HOST}:{port}/mqtt",
                sock=self._socket,
                subprotocols=[Subprotocol("mqtt")],
                max_size=None,
                compression=None,
                ping_interval=None,
                close_timeout=1,
            )

    def send(self, data: bytes) -> None:
        """Send data; ignored if the broker has closed the connection."""
        with contextlib.suppress(OSError, ConnectionClosed):
            if self._websocket is not None:
                self._websocket.send(data)
            else:
                self._socket.sendall(data)

    def read(self, timeout_s: float = PATIENCE_S) -> tuple[int, int, bytes] | None:
        """Type, flags and body of the next packet.

        Raises:
            TimeoutError: No packet arrived in time.
        """
        while True:
            frame = self._next_packet()
            if frame is not None:
                return frame
            data = self._receive(timeout_s)
            if not data:
                return None
            self._buffer += data

    def closed(self, timeout_s: float = PATIENCE_S) -> bool:
        """Whether the broker closes the connection in time; skips pending packets."""
        try:
            while self.read(timeout_s) is not None:
                pass
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        if self._websocket is not None:
            self._websocket.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self, timeout_s: float) -> bytes:
        try:
            if self._websocket is not None:
                data = self._websocket.recv(timeout_s)
                assert isinstance(data, bytes)
                return data
            self._socket.settimeout(timeout_s)
            return self._socket.recv(65_536)
        except (ConnectionError, ConnectionClosed):
            return b""

    def _next_packet(self) -> tuple[int, int, bytes] | None:
        length = shift = 0
        for at, byte in enumerate(self._buffer[1:5], start=2):
            length |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                if len(self._buffer) < at + length:
                    return None
                first, body = self._buffer[0], bytes(self._buffer[at : at + length])
                del self._buffer[: at + length]
                return first >> 4, first & 0x0F, body
        return None


def open_session(
    broker: RunningBroker, client_id: str, credentials: Credentials, transport: Transport = "tcp", **options: Any
) -> RawConnection:
    """A connection after its CONNECT was accepted; ``options``: see ``connect_packet``."""
    raw = RawConnection(broker.port(transport), transport)
    raw.send(connect_packet(client_id, credentials, **options))
    assert raw.read() == ACCEPTED
    return raw
