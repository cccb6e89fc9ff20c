"""One connection of paho's without a thread of its own: one of ours reads, and whoever has something to say writes.

A thread that wrote for all others would have to be woken for each message, and to wait for its turn.
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
    """Thread-safe but for ``open``, ``turn`` and ``close``, which are its one reader's.

    Nothing is called back with its lock held: what a message brings is done by the reader once it has let go of it.

    Args:
        client: Not yet connected, with ``manual_ack``: a message is acknowledged after ``receive`` has returned.
        receive: Called with topic and payload of each message that no broker had kept.

    Attributes:
        silent_s: How long it has listened in vain [s]; where nothing else is said, a ping is answered each keep-alive.
    """

    def __init__(self, client: mqtt.Client, receive: Receive) -> None:
        self._client = client
        self._receive = receive
        self.silent_s = 0.0
        self._settling = False
        self._lock = threading.RLock()
        self._delivered: dict[int, Callable[[], None]] = {}
        self._todo: deque[Callable[[], None]] = deque()
        self._events = selectors.EVENT_READ
        self._selector = selectors.DefaultSelector()
        self._alarm, self._bell = socket.socketpair()
        for end in (self._alarm, self._bell):
            end.setblocking(False)
        self._selector.register(self._alarm, selectors.EVENT_READ)
        client.on_socket_open = _no_delay
        client.on_message = self._on_message
        client.on_publish = self._on_publish

    def open(self, host: str, port: int, *, keep_alive_s: int) -> None:
        """Connect, and say hello; the answer comes in a ``turn``.

        Raises:
            OSError: There is nobody.
        """
        self._client.connect(host, port, keepalive=keep_alive_s)
        sock: Any = self._client.socket()
        if sock is None:
            raise OSError("the broker closed the connection")
        self._selector.register(sock, self._events)

    def publish(
        self, topic: str, payload: bytes, *, qos: int, retain: bool = False, delivered: Callable[[], None] | None = None
    ) -> mqtt.MQTTMessageInfo | None:
        """Send a message, as far as the socket takes it now; ``None`` where there is no connection, or not for long.

        Args:
            topic: Where to.
            payload: What.
            qos: 0 or 1.
            retain: Whether the broker keeps it.
            delivered: Called by the reader once the broker has confirmed it, with QoS 1.
        """
        with self._lock:
            if self._settling:
                return None
            sent = self._client.publish(topic, payload, qos=qos, retain=retain)
            if sent.rc != mqtt.MQTT_ERR_SUCCESS:
                return None
            if delivered is not None:  # nobody can read the confirmation before this is written down
                self._delivered[sent.mid] = delivered
            waits = self._client.want_write()
        if waits:
            self.wake()
        return sent

    def settle(self, within_s: float) -> None:
        """Give the broker a moment to confirm what was told; nothing more is."""
        with self._lock:
            self._settling = True
        until_s = time.monotonic() + within_s
        with contextlib.suppress(OSError, ValueError):
            while (self._delivered or self._todo) and time.monotonic() < until_s:
                self.turn(within_s / 10)

    def later(self, call: Callable[[], None]) -> None:
        """Have the reader do something, after what has come before it."""
        self._todo.append(call)

    def wake(self) -> None:
        """Have the reader's ``turn`` look now."""
        with contextlib.suppress(OSError):  # it is full: then the reader is called already; or all is over
            self._bell.send(b"!")

    def turn(self, within_s: float) -> None:
        """Wait for something to read, or for room to write, and see to it.

        Raises:
            OSError, ValueError: The connection is gone.
        """
        sock: Any = self._client.socket()
        if sock is None:
            raise OSError("the connection is gone")
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._client.want_write() else 0)
        if events != self._events:
            self._selector.modify(sock, events)
            self._events = events
        # With TLS a message may have been decrypted with the one before it: then the socket has nothing more to tell.
        decrypted = isinstance(sock, ssl.SSLSocket) and sock.pending() > 0
        began_s = time.monotonic()
        ready = {key.fileobj: for_ for key, for_ in self._selector.select(0 if decrypted else within_s)}
        heard = decrypted or bool(ready.get(sock, 0) & selectors.EVENT_READ)
        self.silent_s = 0.0 if heard else self.silent_s + time.monotonic() - began_s
        if self._alarm in ready:
            with contextlib.suppress(BlockingIOError):
                self._alarm.recv(4096)
        with self._lock:
            if heard:
                self._client.loop_read()
            if self._client.want_write():
                self._client.loop_write()
            self._client.loop_misc()
        while self._todo:
            self._todo.popleft()()

    def close(self) -> bool:
        """Say farewell, and let go; whether everything was confirmed that somebody waited to hear of."""
        with self._lock:
            confirmed = not self._delivered
            self._delivered.clear()
            self._client.disconnect()
            if (left := self._client.socket()) is not None:
                left.close()
            self._selector.close()
            self._alarm.close()
            self._bell.close()
        return confirmed

    def _on_message(self, _client: mqtt.Client, _userdata: object, message: mqtt.MQTTMessage) -> None:
        self._todo.append(partial(self._take, message))

    def _take(self, message: mqtt.MQTTMessage) -> None:
        if not message.retain:  # an order that a broker kept is not an order of now
            self._receive(message.topic, bytes(message.payload))
        if message.qos:
            with self._lock:
                self._client.ack(message.mid, message.qos)

    def _on_publish(
        self, _client: mqtt.Client, _userdata: object, mid: int, code: ReasonCode, _properties: Properties | None
    ) -> None:
        if not code.is_failure and (delivered := self._delivered.pop(mid, None)) is not None:
            self._todo.append(delivered)


def _no_delay(_client: mqtt.Client, _userdata: object, sock: Any) -> None:
    """Without this a small message can wait 40 ms for the peer's delayed acknowledgement."""
    with contextlib.suppress(OSError, AttributeError):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
