"""A persistent MQTT connection in an event loop.

Messages are sent and received in the loop's thread, without a switch between threads. When a connection is lost or its
credentials expire, a new client connects with new credentials.

Some hosts run the event loop only during a request and freeze the process between requests. A connection may break
undetected during a freeze. Therefore the first message after a freeze needs a fast acknowledgement; otherwise the
connection is replaced and the message is sent again.
"""

import asyncio
import contextlib
import logging
import random
import ssl
import time
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.reasoncodes import ReasonCode

from function_app.adapters.mqtt import event_loop
from function_app.ports.broker_access import BrokerAccessError, ServiceCredentials
from function_app.ports.command_bus import BusUnavailable

KEEP_ALIVE_S = 30
CONNECT_TIMEOUT_S = 5.0
CONFIRM_TIMEOUT_S = 5.0
READY_TIMEOUT_S = 2.0
"""Maximum time that a caller waits for a connection in progress."""
FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
RENEW_BEFORE_S = 30.0
FREEZE_S = 3.0
"""The process was frozen if the loop, which runs at least once per second, did not run for this time."""
SESSION_TIMEOUT_S = 1.5 * KEEP_ALIVE_S
"""The broker closes the connection after this time without a packet (MQTT, 3.1.2.10)."""
VERIFY_TIMEOUT_S = 1.0
"""Maximum time for the first acknowledgement after a freeze."""
MAX_FILTERS = 8
"""Maximum number of filters in one SUBSCRIBE: the limit of AWS IoT Core."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Broker:
    """The address of a broker. ``credentials`` is called for each connection; may raise ``BrokerAccessError``."""

    host: str
    port: int
    credentials: Callable[[], ServiceCredentials | Awaitable[ServiceCredentials]]
    tls: ssl.SSLContext | None = None


class MqttConnection:
    """Connects at ``start`` and stays connected until ``close``."""

    def __init__(
        self,
        broker: Broker,
        *,
        subscriptions: Sequence[str] = (),
        receive: Callable[[mqtt.MQTTMessage], None] | None = None,
        manual_ack: bool = False,
        qos: int = 1,
        every_s: float = 0.0,
    ) -> None:
        self._host = broker.host
        self._port = broker.port
        self._credentials = broker.credentials
        self._subscriptions = tuple(subscriptions)
        self._receive = receive
        self._manual_ack = manual_ack
        self._qos = qos
        self._every_s = every_s
        self._tls = broker.tls
        self._client: mqtt.Client | None = None
        self._task: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()
        self._attempted = asyncio.Event()
        self._lost = asyncio.Event()
        self._waiting: dict[int, asyncio.Future[None]] = {}
        self._subscribed: dict[int, asyncio.Future[None]] = {}
        self._problem = "not connected yet"
        self._last_run = self._clocks()
        self._unverified = False
        self.generation = 0
        """Number of the current connection: a message can only be acknowledged on the connection that delivered it."""

    @property
    def problem(self) -> str:
        """Empty while connected, otherwise a description of the problem."""
        return "" if self._ready.is_set() else self._problem

    def start(self) -> None:
        """Start connecting, without waiting. Idempotent."""
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._run(), name="mqtt link")

    async def ready(self, timeout_s: float) -> bool:
        """Wait until connected and subscribed."""
        self.start()
        self._detect_freeze()
        if self._ready.is_set():
            return True
        try:
            async with asyncio.timeout(timeout_s):
                await self._ready.wait()
        except TimeoutError:
            return False
        return True

    async def attempted(self, timeout_s: float) -> None:
        """Wait until the first connection attempt has succeeded or failed."""
        self.start()
        self._detect_freeze()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._attempted.wait()

    async def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool = False) -> None:
        """Publish; for QoS 1, wait for the acknowledgement. After a freeze, the message may be sent twice.

        Raises:
            BusUnavailable: Not connected, or not acknowledged in time.
        """
        self._detect_freeze()
        generation = self.generation
        if self._unverified:
            if qos == 0:  # never acknowledged
                self._replace(generation, "the process was frozen")
            else:
                try:
                    await self._publish(topic, payload, qos, retain=retain, timeout_s=VERIFY_TIMEOUT_S)
                except BusUnavailable as error:
                    self._replace(generation, str(error))
                else:
                    self._unverified = False
                    return
        await self._publish(topic, payload, qos, retain=retain, timeout_s=CONFIRM_TIMEOUT_S)

    async def _publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, timeout_s: float) -> None:
        if not self._ready.is_set() and not await self.ready(READY_TIMEOUT_S):
            raise BusUnavailable(f"the broker at {self._host}:{self._port} cannot be reached: {self._problem}")
        client = self._client
        if client is None:
            raise BusUnavailable(f"the broker at {self._host}:{self._port} disconnected")
        information = client.publish(topic, payload, qos, retain)
        event_loop.flush(client)
        if information.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise BusUnavailable(f"the broker at {self._host}:{self._port} disconnected: {information.rc.name}")
        if qos == 0:
            return
        acknowledged: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[information.mid] = acknowledged
        try:
            async with asyncio.timeout(timeout_s):
                await acknowledged
        except TimeoutError as error:
            detail = f"the broker at {self._host}:{self._port} did not acknowledge a message in {timeout_s:.0f} s"
            raise BusUnavailable(detail) from error
        finally:
            self._waiting.pop(information.mid, None)

    def acknowledge(self, message: mqtt.MQTTMessage, generation: int) -> None:
        """Acknowledge a message that was received with ``manual_ack``. Does nothing if its connection was closed."""
        if self._client is not None and generation == self.generation:
            self._client.ack(message.mid, message.qos)
            event_loop.flush(self._client)

    async def subscribe(self, patterns: Sequence[str]) -> None:
        """Add subscriptions, on this connection and on later ones."""
        self._subscriptions = tuple(dict.fromkeys((*self._subscriptions, *patterns)))
        client, generation = self._client, self.generation
        if client is None:
            return
        try:
            await self._subscribe(client, patterns)
        except (BusUnavailable, TimeoutError) as error:
            self._replace(generation, str(error) or "a subscription was not acknowledged")

    def unsubscribe(self, patterns: Iterable[str]) -> None:
        """Remove subscriptions."""
        removed = set(patterns)
        self._subscriptions = tuple(pattern for pattern in self._subscriptions if pattern not in removed)
        if self._client is not None and removed:
            self._client.unsubscribe(sorted(removed))
            event_loop.flush(self._client)

    async def close(self) -> None:
        """Disconnect. May be called twice."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None

    async def _run(self) -> None:
        """Connect and reconnect until cancelled."""
        pause_s = FIRST_RETRY_S
        while True:
            client: mqtt.Client | None = None
            try:
                result = self._credentials()
                credentials = result if isinstance(result, ServiceCredentials) else await result
                client = await self._connect(credentials)
                pause_s = FIRST_RETRY_S
                await self._maintain(client, credentials.expires_at)
                continue
            except (BrokerAccessError, BusUnavailable, OSError, ValueError) as error:
                if str(error) != self._problem:
                    _log.warning("broker: %s", error)
                self._problem = str(error)
                self._attempted.set()
            finally:
                self._disconnect(client)
            await asyncio.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 (spreads reconnects)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    async def _connect(self, credentials: ServiceCredentials) -> mqtt.Client:
        """A connected and subscribed client."""
        connected: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        client = self._create_client(credentials, connected)
        try:
            await asyncio.to_thread(client.connect, self._host, self._port, KEEP_ALIVE_S)
            event_loop.listen(client, every_s=self._every_s)
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await connected
            self._client = client
            self.generation += 1
            await self._subscribe(client, self._subscriptions)
        except TimeoutError as error:
            event_loop.drop(client)
            raise BusUnavailable(f"no response from the broker at {self._host}:{self._port}") from error
        except BaseException:
            event_loop.drop(client)
            raise
        self._last_run, self._unverified = self._clocks(), False
        self._ready.set()
        self._attempted.set()
        return client

    def _create_client(  # noqa: C901 (one short callback after another)
        self, credentials: ServiceCredentials, connected: asyncio.Future[None]
    ) -> mqtt.Client:
        # All brokers support 3.1.1. This client needs no properties of version 5, which paho parses slowly.
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2,
            client_id=credentials.client_id,
            protocol=MQTTProtocolVersion.MQTTv311,
            manual_ack=self._manual_ack,
            clean_session=True,
        )
        client.username_pw_set(credentials.username, credentials.password)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        client.connect_timeout = CONNECT_TIMEOUT_S
        client.max_inflight_messages_set(1000)
        event_loop.prepare(client)

        def on_connect(_client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _properties: Any) -> None:
            if connected.done():
                return
            if reason.is_failure:
                problem = f"the broker at {self._host}:{self._port} rejected the connection: {reason.getName()}"
                connected.set_exception(BusUnavailable(problem))
            else:
                connected.set_result(None)

        def disconnected(_client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _properties: Any) -> None:
            if not connected.done():
                connected.set_exception(BusUnavailable(f"the broker closed the connection: {reason.getName()}"))
            if _client is self._client:
                self._problem = f"the connection was lost: {reason.getName()}"
                self._lost.set()

        def published(_client: mqtt.Client, _data: Any, mid: int, _reason: Any, _properties: Any) -> None:
            waiting = self._waiting.get(mid)
            if waiting is not None and not waiting.done():
                waiting.set_result(None)

        def subscribed(_client: mqtt.Client, _data: Any, mid: int, reasons: list[ReasonCode], _properties: Any) -> None:
            waiting = self._subscribed.pop(mid, None)
            if waiting is None or waiting.done():
                return
            rejected = [reason.getName() for reason in reasons if reason.is_failure]
            if rejected:
                waiting.set_exception(BusUnavailable(f"the broker rejected a subscription: {rejected[0]}"))
            else:
                waiting.set_result(None)

        client.on_connect = on_connect
        client.on_disconnect = disconnected
        client.on_publish = published
        client.on_subscribe = subscribed
        if self._receive is not None:
            receive = self._receive
            client.on_message = lambda _client, _data, message: receive(message)
        return client

    async def _subscribe(self, client: mqtt.Client, patterns: Sequence[str]) -> None:
        for start in range(0, len(patterns), MAX_FILTERS):
            filters = [(pattern, self._qos) for pattern in patterns[start : start + MAX_FILTERS]]
            result, mid = client.subscribe(filters)
            if result != MQTTErrorCode.MQTT_ERR_SUCCESS or mid is None:
                raise BusUnavailable("the broker disconnected")
            acknowledged: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._subscribed[mid] = acknowledged
            event_loop.flush(client)
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await acknowledged

    async def _maintain(self, client: mqtt.Client, expires_at: float) -> None:
        """Maintain the connection until it is lost or its credentials are about to expire."""
        while not self._lost.is_set():
            self._detect_freeze()
            client.loop_misc()
            event_loop.flush(client)
            if time.time() > expires_at - RENEW_BEFORE_S:
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._lost.wait()
        raise BusUnavailable(self._problem)

    def _detect_freeze(self) -> None:
        """Compares both clocks, because some hosts also stop the monotonic clock."""
        now = self._clocks()
        last, self._last_run = self._last_run, now
        paused_s = max(now[0] - last[0], now[1] - last[1])
        if paused_s > FREEZE_S and self._ready.is_set():
            self._unverified = True
            if paused_s > SESSION_TIMEOUT_S:
                self._replace(self.generation, "the process was frozen too long")

    def _replace(self, generation: int, reason: str) -> None:
        """Replace the connection unless it has already been replaced."""
        if generation == self.generation and self._ready.is_set():
            self._problem = f"the connection was replaced: {reason}"
            self._ready.clear()
            self._lost.set()

    @staticmethod
    def _clocks() -> tuple[float, float]:
        return time.monotonic(), time.time()

    def _disconnect(self, client: mqtt.Client | None) -> None:
        self._ready.clear()
        self._lost.clear()
        self._client = None
        for waiting in (*self._waiting.values(), *self._subscribed.values()):
            if not waiting.done():
                waiting.set_exception(BusUnavailable(f"the broker at {self._host}:{self._port} disconnected"))
                waiting.exception()  # marks the exception as retrieved
        self._waiting.clear()
        self._subscribed.clear()
        if client is not None:
            event_loop.drop(client)
