"""One agent's broker connection without a thread: paho handles MQTT, the shared event loop handles the socket."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import MQTTProtocolVersion

from device_agent.load_generator.metrics import Metrics
from device_agent.transports.mqtt.connection import disable_nagle
from device_agent.transports.mqtt.transport import KEEP_ALIVE_S, BrokerAccess, new_client

CONNECT_TIMEOUT_S = 10.0
"""Connection timeout [s]; longer than that of a real agent, since many agents connect simultaneously."""
_DISCONNECT_TIMEOUT_S = 2.0


class ProtocolVersion:
    """MQTT version of all agents: 5, or 3.1.1 once a broker has rejected version 5."""

    def __init__(self) -> None:
        self.current = MQTTProtocolVersion.MQTTv5

    def fall_back(self) -> None:
        """Use MQTT 3.1.1 from now on."""
        self.current = MQTTProtocolVersion.MQTTv311


class VersionRejected(Exception):  # noqa: N818 (a result, not an error)
    """The broker supports only MQTT 3.1.1; the next connection uses it."""


class Connection:
    """One MQTT connection. Everything except connecting runs in the event loop.

    ``will`` is topic and payload; ``receive`` is called with topic and payload of each message that was not retained.
    """

    def __init__(
        self,
        access: BrokerAccess,
        version: ProtocolVersion,
        *,
        will: tuple[str, bytes],
        metrics: Metrics,
        receive: Callable[[str, bytes], None],
    ) -> None:
        self.up = False
        self._version_rejected = False
        self._access = access
        self._version = version
        self._metrics = metrics
        self._receive = receive
        self._loop = asyncio.get_running_loop()
        self._lost = self._loop.create_future()
        self._subscribed = self._loop.create_future()
        self._socket: Any = None
        self._flushing = False
        self._sent: dict[int, float] = {}
        self._all_acknowledged: asyncio.Future[None] | None = None
        self._client = self._new_client(will)

    async def open(self, pool: Executor) -> None:
        """Connect and subscribe.

        Raises:
            OSError: The broker cannot be reached, rejects the connection, or does not respond in time.
            VersionRejected: Reconnect immediately with MQTT 3.1.1.
        """
        access = self._access
        # Name resolution and TLS handshake block, so they run in a thread of the pool.
        await self._loop.run_in_executor(pool, self._client.connect, access.host, access.port, KEEP_ALIVE_S)
        self._socket = self._client.socket()
        if self._socket is None:
            raise OSError("the broker closed the connection immediately")
        self._loop.add_reader(self._socket, self._read)
        self._flush()
        await asyncio.wait({self._subscribed, self._lost}, timeout=CONNECT_TIMEOUT_S, return_when="FIRST_COMPLETED")
        if self._version_rejected:
            raise VersionRejected
        if self._lost.done():
            raise OSError(self._lost.result() or "the broker closed the connection")
        if not self._subscribed.done():
            self._version.fall_back()
            raise OSError(f"{access.host}:{access.port} does not respond as an MQTT broker")
        self.up = True

    async def wait_lost(self, timeout_s: float) -> None:
        """Wait until the connection is lost, at most ``timeout_s`` [s]."""
        await asyncio.wait({self._lost}, timeout=timeout_s)

    @property
    def lost(self) -> bool:
        """Whether the connection was lost."""
        return bool(self._lost.done())

    def publish(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> None:
        """Send a message; see ``Transport.publish``."""
        counts = self._metrics.counts
        if not self.up or self._lost.done():
            counts.dropped += 1
            return
        sent = self._client.publish(topic, payload, qos=qos, retain=retain)
        if sent.rc != mqtt.MQTT_ERR_SUCCESS:
            counts.dropped += 1
            return
        counts.out += 1
        counts.out_bytes += len(topic) + len(payload)
        if qos:
            counts.out_qos1 += 1
            self._sent[sent.mid] = time.monotonic()

    def poll(self) -> None:
        """Send MQTT keep-alive messages when they are due; call about once per second."""
        if self.up and not self._lost.done():
            self._client.loop_misc()

    async def close(self, last: tuple[str, bytes] | None = None) -> None:
        """Publish the offline presence and disconnect."""
        if self.up and not self._lost.done():
            if last is not None:
                self.publish(last[0], last[1], qos=1, retain=True)
                self._all_acknowledged = self._loop.create_future()
                await asyncio.wait(
                    {self._all_acknowledged, self._lost}, timeout=_DISCONNECT_TIMEOUT_S, return_when="FIRST_COMPLETED"
                )
            self._client.disconnect()
            self._flush()
        self._remove_handlers()
        opened = self._client.socket()
        if opened is not None:
            opened.close()

    # ------------------------------------------------------------ paho and the event loop

    def _new_client(self, will: tuple[str, bytes]) -> mqtt.Client:
        client = new_client(self._access, self._version.current, will, connect_timeout_s=CONNECT_TIMEOUT_S)
        client.on_socket_open = disable_nagle
        client.on_socket_close = lambda *_: self._remove_handlers()
        client.on_socket_register_write = lambda *_: self._schedule_flush()
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_publish = self._on_publish
        client.on_message = self._on_message
        return client

    def _read(self) -> None:
        self._client.loop_read()
        pending = getattr(self._socket, "pending", None)  # data that TLS has already decrypted
        while pending is not None and self._socket is not None and pending() > 0:
            self._client.loop_read()

    def _schedule_flush(self) -> None:
        """Schedule one write for all pending data."""
        if self._socket is not None and not self._flushing:
            self._flushing = True
            self._loop.call_soon(self._flush)

    def _flush(self) -> None:
        self._flushing = False
        if self._socket is None:
            return
        self._client.loop_write()
        if self._socket is None:
            return
        if self._client.want_write():
            self._loop.add_writer(self._socket, self._flush)
        else:
            self._loop.remove_writer(self._socket)

    def _remove_handlers(self) -> None:
        opened, self._socket = self._socket, None
        if opened is not None:
            self._loop.remove_reader(opened)
            self._loop.remove_writer(opened)

    def _end(self, reason: str) -> None:
        if not self._lost.done():
            self._lost.set_result(reason)

    def _on_connect(self, client: mqtt.Client, _data: object, _flags: object, code: Any, _properties: object) -> None:
        if code.is_failure:
            if "protocol" in str(code).lower() and self._client.protocol is MQTTProtocolVersion.MQTTv5:
                self._version_rejected = True
                self._version.fall_back()
            self._end(f"the broker rejected the connection: {code}")
            return
        client.subscribe([(pattern, 1) for pattern in self._access.subscribe])

    def _on_subscribe(self, _client: object, _data: object, _mid: int, codes: list[Any], _properties: object) -> None:
        if any(code.is_failure for code in codes):
            self._end("the broker rejected a subscription")
        elif not self._subscribed.done():
            self._subscribed.set_result(None)

    def _on_disconnect(self, _client: object, _data: object, _flags: object, code: Any, _properties: object) -> None:
        self._end(f"the broker ended the connection: {code}" if code.is_failure else "")

    def _on_publish(self, _client: object, _data: object, mid: int, code: Any, _properties: object) -> None:
        sent_s = self._sent.pop(mid, None)
        if sent_s is not None and not code.is_failure:
            self._metrics.counts.confirmed += 1
            self._metrics.confirm_ms.append((time.monotonic() - sent_s) * 1000)
        waiting = self._all_acknowledged
        if waiting is not None and not self._sent and not waiting.done():
            waiting.set_result(None)

    def _on_message(self, _client: object, _data: object, message: mqtt.MQTTMessage) -> None:
        self._metrics.counts.received += 1
        self._metrics.counts.in_bytes += len(message.topic) + len(message.payload)
        if not message.retain:
            self._receive(message.topic, bytes(message.payload))
