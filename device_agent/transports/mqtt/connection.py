"""One paho connection without its own thread: the transport's thread reads, and every caller writes directly.

A separate writer thread would have to be woken for each message, and to wait for its turn.
"""

import contextlib
import selectors
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

Receive = Callable[[str, bytes], None]


class Connection:
    """One MQTT connection. Thread-safe, except that one thread, the reader, calls ``open``, ``turn`` and ``close``.

    Callbacks run without the connection's lock, in the reader's thread.

    Args:
        client: Client with ``manual_ack``, not connected. Messages are acknowledged after ``receive`` returns.
        receive: Called with topic and payload of each message that is not retained.

    Attributes:
        silent_s: Time without received data [s]. Without other traffic, pings are answered every keep-alive interval.
    """

    def __init__(self, client: mqtt.Client, receive: Receive) -> None:
        self._client = client
        self._receive = receive
        self.silent_s = 0.0
        self._settling = False
        self._lock = threading.RLock()
        self._delivered: dict[int, Callable[[], None]] = {}
        self._pending_calls: deque[Callable[[], None]] = deque()
        self._events = selectors.EVENT_READ
        self._selector = selectors.DefaultSelector()
        self._wake_reader, self._wake_writer = socket.socketpair()
        for end in (self._wake_reader, self._wake_writer):
            end.setblocking(False)
        self._selector.register(self._wake_reader, selectors.EVENT_READ)
        client.on_socket_open = disable_nagle
        client.on_message = self._on_message
        client.on_publish = self._on_publish

    def open(self, host: str, port: int, *, keep_alive_s: int) -> None:
        """Connect and send CONNECT; a later ``turn`` reads the response.

        Raises:
            OSError: The broker cannot be reached.
        """
        self._client.connect(host, port, keepalive=keep_alive_s)
        sock: Any = self._client.socket()
        if sock is None:
            raise OSError("the broker closed the connection")
        self._selector.register(sock, self._events)

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> mqtt.MQTTMessageInfo | None:
        """Send a message as far as the socket accepts it; returns ``None`` without a connection, or while it settles.

        Args:
            topic: Topic.
            payload: Payload.
            qos: 0 or 1.
            retain: Whether the broker retains the message.
            delivered: With QoS 1, called by the reader once the broker has acknowledged the message.
        """
        with self._lock:
            if self._settling:
                return None
            sent = self._client.publish(topic, payload, qos=qos, retain=retain)
            if sent.rc != mqtt.MQTT_ERR_SUCCESS:
                return None
            if delivered is not None:  # registered before the acknowledgement can be read
                self._delivered[sent.mid] = delivered
            waits = self._client.want_write()
        if waits:
            self.wake()
        return sent

    def settle(self, within_s: float) -> None:
        """Accept no more messages, and wait for acknowledgements of the broker."""
        with self._lock:
            self._settling = True
        until_s = time.monotonic() + within_s
        with contextlib.suppress(OSError, ValueError):
            while (self._delivered or self._pending_calls) and time.monotonic() < until_s:
                self.turn(within_s / 10)

    def later(self, call: Callable[[], None]) -> None:
        """Run a call in the reader's thread, after pending ones."""
        self._pending_calls.append(call)

    def wake(self) -> None:
        """Wake the reader's ``turn``."""
        with contextlib.suppress(OSError):  # full: the reader is already woken; or closed
            self._wake_writer.send(b"!")

    def turn(self, within_s: float) -> None:
        """Wait until data can be read or written, and process it.

        Raises:
            OSError, ValueError: The connection is lost.
        """
        sock: Any = self._client.socket()
        if sock is None:
            raise OSError("the connection is lost")
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._client.want_write() else 0)
        if events != self._events:
            self._selector.modify(sock, events)
            self._events = events
        # TLS may have decrypted several messages; the socket does not signal those.
        decrypted = isinstance(sock, ssl.SSLSocket) and sock.pending() > 0
        started_s = time.monotonic()
        ready = {key.fileobj: for_ for key, for_ in self._selector.select(0 if decrypted else within_s)}
        readable = decrypted or bool(ready.get(sock, 0) & selectors.EVENT_READ)
        self.silent_s = 0.0 if readable else self.silent_s + time.monotonic() - started_s
        if self._wake_reader in ready:
            with contextlib.suppress(BlockingIOError):
                self._wake_reader.recv(4096)
        with self._lock:
            if readable:
                self._client.loop_read()
            if self._client.want_write():
                self._client.loop_write()
            self._client.loop_misc()
        while self._pending_calls:
            self._pending_calls.popleft()()

    def close(self) -> bool:
        """Disconnect. Returns True if all tracked messages were acknowledged."""
        with self._lock:
            confirmed = not self._delivered
            self._delivered.clear()
            self._client.disconnect()
            if (remaining := self._client.socket()) is not None:
                remaining.close()
            self._selector.close()
            self._wake_reader.close()
            self._wake_writer.close()
        return confirmed

    def _on_message(self, _client: mqtt.Client, _userdata: object, message: mqtt.MQTTMessage) -> None:
        self._pending_calls.append(partial(self._take, message))

    def _take(self, message: mqtt.MQTTMessage) -> None:
        if not message.retain:  # a retained command is outdated
            self._receive(message.topic, bytes(message.payload))
        if message.qos:
            with self._lock:
                self._client.ack(message.mid, message.qos)

    def _on_publish(
        self, _client: mqtt.Client, _userdata: object, mid: int, code: ReasonCode, _properties: Properties | None
    ) -> None:
        if not code.is_failure and (delivered := self._delivered.pop(mid, None)) is not None:
            self._pending_calls.append(delivered)


def disable_nagle(_client: mqtt.Client, _userdata: object, sock: Any) -> None:
    """Set TCP_NODELAY: without this option a small message may wait 40 ms for the peer's delayed acknowledgement."""
    with contextlib.suppress(OSError, AttributeError):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
