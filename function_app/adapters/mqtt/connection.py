"""One warm MQTT connection inside an event loop.

A message goes out, and comes in, on the loop's own thread: no hand-over between threads lies in a command's way. A
connection lives as long as its credentials; then, or when it breaks, a new client with new ones takes over.

Some hosts let the loop turn during a call only, and freeze the process between two. A connection from before the frost
may be dead without a sign: it has to prove itself with the first message, which goes out again over a new one if not.
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
"""A caller waits this long for a connection that is just being made."""
FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0
RENEW_BEFORE_S = 30.0
FROST_S = 3.0
"""So long without a turn of the loop, which has one each second at least, and the process was frozen."""
DEAD_S = 1.5 * KEEP_ALIVE_S
"""The broker closes the connection after this time without a packet (MQTT, 3.1.2.10)."""
PROOF_TIMEOUT_S = 1.0
"""A connection that was frozen has this long to confirm a message."""
MAX_FILTERS = 8
"""Filters in one SUBSCRIBE (facts: AWS IoT Core takes eight)."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Broker:
    """Where a broker is, and how to be let in. ``credentials`` is asked for each connection; may raise the port's."""

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
        self._keeper: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()
        self._attempted = asyncio.Event()
        self._lost = asyncio.Event()
        self._waiting: dict[int, asyncio.Future[None]] = {}
        self._subscribed: dict[int, asyncio.Future[None]] = {}
        self._trouble = "not connected yet"
        self._turn_at = self._clocks()
        self._unproven = False
        self.generation = 0
        """Number of the present connection: a message can only be confirmed on the one it came by."""

    @property
    def trouble(self) -> str:
        """Empty while connected, else a sentence."""
        return "" if self._ready.is_set() else self._trouble

    def start(self) -> None:
        """Begin to connect; returns at once. Does nothing the second time."""
        if self._keeper is None:
            self._keeper = asyncio.get_running_loop().create_task(self._keep(), name="mqtt link")

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
        """Wait until it is known whether the broker can be reached, but no longer than the first try takes."""
        self.start()
        self._detect_freeze()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._attempted.wait()

    async def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool = False) -> None:
        """Send, and for QoS 1 wait for the broker's word. After a frost it may be sent twice.

        Raises:
            BusUnavailable: Not connected, or not confirmed in time.
        """
        self._detect_freeze()
        generation = self.generation
        if self._unproven:
            if qos == 0:  # never confirmed
                self._abandon(generation, "it was frozen")
            else:
                try:
                    await self._publish(topic, payload, qos, retain=retain, timeout_s=PROOF_TIMEOUT_S)
                except BusUnavailable as error:
                    self._abandon(generation, str(error))
                else:
                    self._unproven = False
                    return
        await self._publish(topic, payload, qos, retain=retain, timeout_s=CONFIRM_TIMEOUT_S)

    async def _publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, timeout_s: float) -> None:
        if not self._ready.is_set() and not await self.ready(READY_TIMEOUT_S):
            raise BusUnavailable(f"the broker at {self._host}:{self._port} cannot be reached: {self._trouble}")
        client = self._client
        if client is None:
            raise BusUnavailable(f"the broker at {self._host}:{self._port} went away")
        information = client.publish(topic, payload, qos, retain)
        event_loop.flush(client)
        if information.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise BusUnavailable(f"the broker at {self._host}:{self._port} went away: {information.rc.name}")
        if qos == 0:
            return
        confirmed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[information.mid] = confirmed
        try:
            async with asyncio.timeout(timeout_s):
                await confirmed
        except TimeoutError as error:
            detail = f"the broker at {self._host}:{self._port} did not confirm a message in {timeout_s:.0f} s"
            raise BusUnavailable(detail) from error
        finally:
            self._waiting.pop(information.mid, None)

    def acknowledge(self, message: mqtt.MQTTMessage, generation: int) -> None:
        """Confirm a message that came with ``manual_ack``; nothing happens when its connection is gone."""
        if self._client is not None and generation == self.generation:
            self._client.ack(message.mid, message.qos)
            event_loop.flush(self._client)

    async def subscribe(self, patterns: Sequence[str]) -> None:
        """Subscribe to these too, on this connection and on those that follow."""
        self._subscriptions = tuple(dict.fromkeys((*self._subscriptions, *patterns)))
        client, generation = self._client, self.generation
        if client is None:
            return
        try:
            await self._subscribe(client, patterns)
        except (BusUnavailable, TimeoutError) as error:
            self._abandon(generation, str(error) or "a subscription was not confirmed")

    def unsubscribe(self, patterns: Iterable[str]) -> None:
        """Subscribe to these no longer."""
        gone = set(patterns)
        self._subscriptions = tuple(pattern for pattern in self._subscriptions if pattern not in gone)
        if self._client is not None and gone:
            self._client.unsubscribe(sorted(gone))
            event_loop.flush(self._client)

    async def close(self) -> None:
        """Disconnect. May be called twice."""
        if self._keeper is not None:
            self._keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._keeper
            self._keeper = None

    async def _keep(self) -> None:
        """Connect, stay, and connect again, for ever."""
        pause_s = FIRST_RETRY_S
        while True:
            client: mqtt.Client | None = None
            try:
                given = self._credentials()
                credentials = given if isinstance(given, ServiceCredentials) else await given
                client = await self._connect(credentials)
                pause_s = FIRST_RETRY_S
                await self._stay(client, credentials.expires_at)
                continue
            except (BrokerAccessError, BusUnavailable, OSError, ValueError) as error:
                if str(error) != self._trouble:
                    _log.warning("broker: %s", error)
                self._trouble = str(error)
                self._attempted.set()
            finally:
                self._disconnect(client)
            await asyncio.sleep(pause_s * random.uniform(0.5, 1.0))  # noqa: S311 (spreads reconnects, hides nothing)
            pause_s = min(2 * pause_s, LAST_RETRY_S)

    async def _connect(self, credentials: ServiceCredentials) -> mqtt.Client:
        """A connected and subscribed client."""
        answered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        client = self._make(credentials, answered)
        try:
            await asyncio.to_thread(client.connect, self._host, self._port, KEEP_ALIVE_S)
            event_loop.listen(client, every_s=self._every_s)
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await answered
            self._client = client
            self.generation += 1
            await self._subscribe(client, self._subscriptions)
        except TimeoutError as error:
            event_loop.drop(client)
            raise BusUnavailable(f"no answer from the broker at {self._host}:{self._port}") from error
        except BaseException:
            event_loop.drop(client)
            raise
        self._turn_at, self._unproven = self._clocks(), False
        self._ready.set()
        self._attempted.set()
        return client

    def _make(  # noqa: C901 (one short callback after another)
        self, credentials: ServiceCredentials, answered: asyncio.Future[None]
    ) -> mqtt.Client:
        # All brokers speak 3.1.1. Nothing here needs the properties of 5, which paho takes long to read.
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

        def connected(_client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _properties: Any) -> None:
            if answered.done():
                return
            if reason.is_failure:
                refusal = f"the broker at {self._host}:{self._port} refused us: {reason.getName()}"
                answered.set_exception(BusUnavailable(refusal))
            else:
                answered.set_result(None)

        def disconnected(_client: mqtt.Client, _data: Any, _flags: Any, reason: ReasonCode, _properties: Any) -> None:
            if not answered.done():
                answered.set_exception(BusUnavailable(f"the broker closed the connection: {reason.getName()}"))
            if _client is self._client:
                self._trouble = f"the connection was lost: {reason.getName()}"
                self._lost.set()

        def published(_client: mqtt.Client, _data: Any, mid: int, _reason: Any, _properties: Any) -> None:
            waiting = self._waiting.get(mid)
            if waiting is not None and not waiting.done():
                waiting.set_result(None)

        def subscribed(_client: mqtt.Client, _data: Any, mid: int, reasons: list[ReasonCode], _properties: Any) -> None:
            waiting = self._subscribed.pop(mid, None)
            if waiting is None or waiting.done():
                return
            refused = [reason.getName() for reason in reasons if reason.is_failure]
            if refused:
                waiting.set_exception(BusUnavailable(f"the broker refused a subscription: {refused[0]}"))
            else:
                waiting.set_result(None)

        client.on_connect = connected
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
                raise BusUnavailable("the broker went away")
            done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._subscribed[mid] = done
            event_loop.flush(client)
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await done

    async def _stay(self, client: mqtt.Client, expires_at: float) -> None:
        """Keep the connection alive until it breaks or its credentials are about to end."""
        while not self._lost.is_set():
            self._detect_freeze()
            client.loop_misc()
            event_loop.flush(client)
            if time.time() > expires_at - RENEW_BEFORE_S:
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._lost.wait()
        raise BusUnavailable(self._trouble)

    def _detect_freeze(self) -> None:
        """Called whenever the loop turns. Both clocks, since some hosts stop the monotonic one too."""
        now = self._clocks()
        still_s = max(new - old for new, old in zip(now, self._turn_at, strict=True))
        self._turn_at = now
        if still_s > FROST_S and self._ready.is_set():
            self._unproven = True
            if still_s > DEAD_S:
                self._abandon(self.generation, "the process was frozen too long")

    def _abandon(self, generation: int, reason: str) -> None:
        """Have another connection made, unless that has happened since this one."""
        if generation == self.generation and self._ready.is_set():
            self._trouble = f"the connection was given up: {reason}"
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
                waiting.set_exception(BusUnavailable(f"the broker at {self._host}:{self._port} went away"))
                waiting.exception()  # retrieved here too: an exception without a waiting caller is no error
        self._waiting.clear()
        self._subscribed.clear()
        if client is not None:
            event_loop.drop(client)
