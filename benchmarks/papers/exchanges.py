"""One message from a sender through a server to a receiver, for each transport.

Each function yields an exchange, which sends one setpoint and returns when the receiver has it. Sender and receiver are
separate connections in this process, so one clock measures both; servers run in their own processes.
"""

import asyncio
import contextlib
import json
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

from websockets.sync.client import connect

from benchmarks.baseline.interleaved import Exchange
from benchmarks.baseline.product import TIMEOUT_S
from device_agent.protocol import JointTarget, Setpoint, codec
from device_agent.protocol.xmpp import stanzas
from device_agent.protocol.xmpp.stream import Login, Stream
from tests.harness.network.brokers import HOST, Client, RunningBroker, Transport
from tests.harness.network.xmpp import DOMAIN

JOINTS: Final = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
SETPOINT: Final = codec.encode(
    Setpoint(
        epoch=7,
        sequence=1234,
        echo_tick_ms=123456789,
        sent_ms=1234567.25,
        target=JointTarget(position_rad={name: round(0.1 * index + 0.05, 3) for index, name in enumerate(JOINTS)}),
    )
)
"""Payload of a console that moves six sliders."""
Ports = Mapping[int, int]
"""Maps a server's port to the port for clients: the same one or that of a delay proxy."""
_TOPIC: Final = "bench/setpoint"
_CLOUD, _ROBOT = "cloud", "robot"


def mqtt(stack: contextlib.ExitStack, ports: Ports, broker: RunningBroker, transport: Transport = "tcp") -> Exchange:
    """MQTT with QoS 0, as used for setpoints."""
    port = ports[broker.port(transport)]
    topic = f"{_TOPIC}/{port}"  # TCP and WebSocket of one broker are two paths and use separate topics
    received: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def open_client(name: str) -> Client:
        grant = broker.grant(f"{name}-{port}", publish=(topic,), subscribe=(topic,), lifetime_s=3600)
        client = Client(grant.client_id, broker.issue(grant), port=port, transport=transport)
        return stack.enter_context(client.open())

    sender, receiver = open_client("sender"), open_client("receiver")
    receiver.paho.on_message = lambda _c, _u, message: received.put(bytes(message.payload))
    receiver.subscribe(topic, qos=0)

    def exchange() -> None:
        _require_empty(received)
        sender.publish(topic, SETPOINT, qos=0)
        received.get(timeout=TIMEOUT_S)

    return exchange


def web_socket(stack: contextlib.ExitStack, ports: Ports, port: int) -> Exchange:
    """JSON over WebSocket through a relay server."""
    address = f"ws://{HOST}:{ports[port]}"
    sender, receiver = (stack.enter_context(connect(address, compression=None)) for _ in range(2))
    text = json.dumps({"op": "publish", "topic": _TOPIC, "msg": json.loads(SETPOINT)})

    def exchange() -> None:
        sender.send(text)
        receiver.recv(timeout=TIMEOUT_S)

    return exchange


def xmpp(stack: contextlib.ExitStack, ports: Ports, port: int) -> Exchange:
    """An XMPP message between two users of Prosody."""
    received: queue.SimpleQueue[Any] = queue.SimpleQueue()
    sender = stack.enter_context(_XmppUser(ports[port], _CLOUD, lambda _: None))
    receiver = stack.enter_context(_XmppUser(ports[port], _ROBOT, received.put))
    stanza = stanzas.message(receiver.jid, _TOPIC, SETPOINT)

    def exchange() -> None:
        _require_empty(received)
        sender.send(stanza)
        received.get(timeout=TIMEOUT_S)

    return exchange


def _require_empty(received: "queue.SimpleQueue[Any]") -> None:
    if not received.empty():
        raise RuntimeError("received a message of an earlier exchange")


class _XmppUser:
    """An XMPP client in its own thread. Leaving the context stops it."""

    def __init__(self, port: int, name: str, received: Callable[[Any], None]) -> None:
        self.jid = f"{name}@{DOMAIN}/bench"
        self._login = Login(HOST, port, self.jid, "any")
        self._received = received
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    async def _open(self) -> None:
        self._stream = Stream(self._login, message=self._received, presence=lambda _: None)
        await self._stream.open()
        self._reader = asyncio.create_task(self._stream.stay())

    async def _close(self) -> None:
        self._reader.cancel()
        await asyncio.gather(self._reader, return_exceptions=True)
        await self._stream.close()

    def send(self, stanza: str) -> None:
        self._loop.call_soon_threadsafe(self._stream.send, stanza)

    def __enter__(self) -> Self:
        self._run(self._open())
        return self

    def __exit__(self, *_: object) -> None:
        self._run(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(TIMEOUT_S)
