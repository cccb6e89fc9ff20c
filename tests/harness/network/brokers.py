"""Real brokers for tests: one process each on free loopback ports, with credentials like those of the functions."""

import asyncio
import contextlib
import json
import queue
import secrets
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, cast

import paho.mqtt.client as paho
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from paho.mqtt.enums import CallbackAPIVersion

from device_agent.protocol.security import signing
from device_agent.protocol.security.grants import Grant
from function_app.adapters.local.broker_access import MosquittoBrokerAccess, TokenBrokerAccess
from function_app.ports.broker_access import BrokerAccess, Credentials
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT

BrokerKind = Literal["amqtt", "mosquitto"]
Transport = Literal["tcp", "websockets"]
BROKERS: tuple[BrokerKind, ...] = ("amqtt", "mosquitto")
MODULES = {"amqtt": "infra.embedded_broker", "mosquitto": "infra.mosquitto"}
TRANSPORTS: tuple[Transport, ...] = ("tcp", "websockets")
HOST = "127.0.0.1"
PATIENCE_S = 120.0
"""Timeout for expected events [s]; generous, because the machine may be slow and busy."""
SILENCE_S = 0.4
"""Waiting time for events that must not happen [s], after a later event on the same path."""

T = TypeVar("T")


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = PATIENCE_S) -> None:
    """Poll until ``condition`` holds, at a growing interval; fails with ``what`` after the timeout."""
    start = time.monotonic()
    while not condition():
        waited_s = time.monotonic() - start
        assert waited_s < timeout_s, f"waited {timeout_s} s for {what}"
        time.sleep(min(max(0.002, 0.1 * waited_s), 0.025))


@dataclass
class Message:
    topic: str
    payload: bytes
    qos: int
    retain: bool


class Client:
    """One paho client and its received messages; a context manager that disconnects."""

    def __init__(
        self,
        client_id: str,
        credentials: Credentials | None,
        *,
        port: int,
        transport: Transport = "tcp",
        protocol: int = paho.MQTTv311,
        keep_alive_s: int = 60,
        will: Message | None = None,
        tls: ssl.SSLContext | None = None,
        on_message: Callable[[Message], None] | None = None,
    ) -> None:
        self.client_id = client_id
        self.messages: queue.Queue[Message] = queue.Queue()
        self.answer: str | None = None
        self.answer_code: int | None = None
        self.connected = threading.Event()
        self.disconnected = threading.Event()
        self._port = port
        self._handle = on_message
        self._keep_alive_s = keep_alive_s
        self._acknowledged: set[int] = set()
        self._granted: dict[int, list[int]] = {}
        self.paho = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=client_id,
            protocol=protocol,  # type: ignore[arg-type]
            transport=transport,
            reconnect_on_failure=False,
        )
        if tls is not None:
            self.paho.tls_set_context(tls)
        if credentials is not None:
            self.paho.username_pw_set(*credentials)
        if will is not None:
            self.paho.will_set(will.topic, will.payload, will.qos, will.retain)
        self.paho.on_connect = self._on_connect
        self.paho.on_disconnect = self._on_disconnect
        self.paho.on_message = self._on_message
        self.paho.on_subscribe = self._on_subscribe
        self.paho.on_publish = self._on_publish
        self.paho.on_socket_open = _disable_nagle

    def open(self) -> Self:
        """Connect and wait for the broker's response: see ``connected``, ``answer``."""
        with contextlib.suppress(OSError):
            self.paho.connect(HOST, self._port, self._keep_alive_s)
            self.paho.loop_start()
            wait_until(lambda: self.connected.is_set() or self.disconnected.is_set(), "an answer to CONNECT")
        return self

    def subscribe(self, *filters: str, qos: int = 1) -> list[int]:
        _, mid = self.paho.subscribe([(each, qos) for each in filters])
        assert mid is not None
        wait_until(lambda: mid in self._granted or self.disconnected.is_set(), "a SUBACK")
        return self._granted.get(mid, [])

    def publish(self, topic: str, payload: bytes | str = b"", *, qos: int = 1, retain: bool = False) -> int:
        """Publish without waiting; returns the message id for ``acknowledged``."""
        return self.paho.publish(topic, payload, qos, retain).mid

    def publish_acknowledged(self, topic: str, payload: bytes | str = b"", *, retain: bool = False) -> None:
        mid = self.publish(topic, payload, retain=retain)
        wait_until(lambda: mid in self._acknowledged, f"a PUBACK for {topic}")

    def acknowledged(self, mid: int) -> bool:
        return mid in self._acknowledged

    def receive(self, timeout_s: float = PATIENCE_S) -> Message:
        try:
            return self.messages.get(timeout=timeout_s)
        except queue.Empty:
            raise AssertionError(f"{self.client_id} received nothing in {timeout_s} s") from None

    def payloads(self, count: int) -> list[bytes]:
        return [self.receive().payload for _ in range(count)]

    def ended(self) -> bool:
        """Whether the connection ends in time."""
        return self.disconnected.wait(PATIENCE_S)

    def pending(self) -> list[Message]:
        messages = []
        with contextlib.suppress(queue.Empty):
            while True:
                messages.append(self.messages.get_nowait())
        return messages

    def vanish(self) -> None:
        """Close the socket without DISCONNECT."""
        opened = self.paho.socket()
        assert opened is not None
        raw: Any = getattr(opened, "_socket", opened)
        raw.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()
        self.paho._reset_sockets()  # see function_app/adapters/shared/mqtt_client.py

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_connect(self, _: Any, __: Any, ___: Any, reason: Any, ____: Any) -> None:
        self.answer, self.answer_code = str(reason), reason.value
        if not reason.is_failure:
            self.connected.set()

    def _on_disconnect(self, *_: Any) -> None:
        self.disconnected.set()

    def _on_message(self, _: Any, __: Any, message: paho.MQTTMessage) -> None:
        received = Message(message.topic, bytes(message.payload), message.qos, message.retain)
        self.messages.put(received)
        if self._handle is not None:
            self._handle(received)

    def _on_subscribe(self, _: Any, __: Any, mid: int, codes: Any, ___: Any) -> None:
        self._granted[mid] = [code.value for code in codes]

    def _on_publish(self, _: Any, __: Any, mid: int, reason: Any, ___: Any) -> None:
        if not reason.is_failure:
            self._acknowledged.add(mid)


@dataclass
class RunningBroker:
    """A broker process and the functions' access to it."""

    kind: BrokerKind
    home: Path
    process: "subprocess.Popen[str]"
    tcp_port: int
    websocket_port: int
    loop: asyncio.AbstractEventLoop
    key: Any = None
    access: BrokerAccess = field(default=cast("BrokerAccess", None))
    closers: list[Callable[[], None]] = field(default_factory=list)

    def port(self, transport: Transport) -> int:
        return self.tcp_port if transport == "tcp" else self.websocket_port

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine of ``access`` from a synchronous test."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(PATIENCE_S)

    def grant(
        self,
        client_id: str,
        *,
        publish: tuple[str, ...] = (),
        subscribe: tuple[str, ...] = (),
        principal: str = "",
        lifetime_s: float = 300,
    ) -> Grant:
        return Grant(
            principal=principal or f"account:{client_id}",
            client_id=client_id,
            publish=publish,
            subscribe=subscribe,
            token_id=secrets.token_hex(8),
            expires_at=int(time.time() + lifetime_s),
        )

    def issue(self, grant: Grant) -> Credentials:
        return self.run(self.access.issue(grant))

    def revoke(self, *, client_id: str | None = None, principal: str | None = None) -> None:
        self.run(self.access.revoke(client_id=client_id, principal=principal))

    def short_lived(self, client_id: str, *, publish: tuple[str, ...] = (), **options: Any) -> tuple[Grant, Client]:
        """A connected client whose credentials expire soon; longer lifetimes on slow machines."""
        for lifetime_s in (3, 6, 12, 24, 48):
            grant = self.grant(client_id, publish=publish, lifetime_s=lifetime_s)
            client = self.connect(client_id, self.issue(grant), **options)
            if client.connected.is_set():
                return grant, client
            client.close()
            assert time.time() >= grant.expires_at, f"{client_id} was rejected too early: {client.answer}"
        raise AssertionError(f"{client_id} could not connect in {lifetime_s} s")

    def expire(self) -> None:
        self.run(self.access.expire(time.time()))

    def connect(self, client_id: str, credentials: Credentials | None, **options: Any) -> Client:
        """A client after a connection attempt; defaults: TCP and MQTT 3.1.1."""
        transport: Transport = options.pop("transport", "tcp")
        return Client(client_id, credentials, port=self.port(transport), transport=transport, **options).open()

    def accepts(self, client_id: str, credentials: Credentials | None, **options: Any) -> bool:
        """Whether a client can connect; it disconnects at once."""
        with self.connect(client_id, credentials, **options) as client:
            return client.connected.is_set()

    def client(
        self, client_id: str, *, publish: tuple[str, ...] = (), subscribe: tuple[str, ...] = (), **options: Any
    ) -> Client:
        """A connected client with exactly these rights."""
        client = self.connect(
            client_id, self.issue(self.grant(client_id, publish=publish, subscribe=subscribe)), **options
        )
        assert client.connected.is_set(), f"{client_id} was rejected: {client.answer}"
        return client

    def service(self, **options: Any) -> Client:
        """A connection with the functions' own credentials."""
        service = self.access.service_credentials()
        client = self.connect(service.client_id, Credentials(service.username, service.password), **options)
        assert client.connected.is_set(), f"the functions were rejected: {client.answer}"
        return client

    def stderr(self) -> str:
        return (self.home / "broker.stderr").read_text()

    def stop(self) -> int:
        """Stop the broker by SIGTERM; returns its exit code."""
        self.process.terminate()
        return self.process.wait(PATIENCE_S)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE_S)


@contextlib.contextmanager
def start_broker(
    kind: BrokerKind,
    home: Path,
    *,
    tcp_port: int = 0,
    websocket_port: int = 0,
    keys: Path | None = None,
    more: Sequence[str] = (),
    tls: ssl.SSLContext | None = None,
    launcher: Sequence[str] = (),
) -> Iterator[RunningBroker]:
    """Run a broker within a ``with`` block.

    Args:
        kind: The broker.
        home: Its folder; a second start with the same folder reuses its files.
        tcp_port, websocket_port: 0 selects a free port.
        keys: For amqtt: public keys of the functions under test; ``access`` cannot issue grants then.
        more: Additional arguments of the program.
        tls: TLS context of the functions' own clients, if ``more`` enables TLS.
        launcher: Module and arguments of a program that runs the broker.
    """
    home.mkdir(parents=True, exist_ok=True)
    ports = [*more, "--host", HOST, "--tcp-port", str(tcp_port or free_port())]
    ports += ["--websocket-port", str(websocket_port or free_port())]
    key = None
    if kind == "amqtt":
        key, own = _keys(home)
        arguments = ["infra.embedded_broker", *ports, "--keys", str(keys or own)]
    else:
        arguments = ["infra.mosquitto", *ports, "--home", str(home)]
    with (home / "broker.stderr").open("a") as stderr, _running_loop() as loop:
        process = subprocess.Popen(
            [sys.executable, "-m", *launcher, *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=stderr, text=True
        )
        with process:
            broker = None
            try:
                tcp, websocket = _ready(process, home)
                broker = RunningBroker(kind, home, process, tcp, websocket, loop, key)
                broker.access = _access(broker, tls)
                yield broker
            finally:
                if broker is not None:
                    broker.run(broker.access.close())
                    for close in broker.closers:
                        close()
                if process.poll() is None:
                    process.terminate()
                    process.wait(PATIENCE_S)


def _ready(process: "subprocess.Popen[str]", home: Path) -> tuple[int, int]:
    assert process.stdout is not None
    line = process.stdout.readline()
    ports = dict(part.split("=") for part in line.split()[1:]) if line.startswith("ready ") else {}
    errors = (home / "broker.stderr").read_text()
    assert {"tcp", "websocket"} <= set(ports), f"broker did not start: {line!r} {errors}"
    return int(ports["tcp"]), int(ports["websocket"])


def _keys(home: Path) -> tuple[Any, Path]:
    """A signing key that stays the same for one home."""
    path, private = home / "public.json", home / "private.bin"
    if private.exists():
        key = Ed25519PrivateKey.from_private_bytes(private.read_bytes())
    else:
        key = signing.generate()
        private.write_bytes(key.private_bytes_raw())
    path.write_text(json.dumps({signing.key_id(key.public_key()): signing.public_text(key.public_key())}))
    return key, path


def _access(broker: RunningBroker, tls: ssl.SSLContext | None) -> BrokerAccess:
    if broker.kind == "mosquitto":
        return MosquittoBrokerAccess(
            host=HOST, port=broker.tcp_port, username="service", password_file=broker.home / "service.password", tls=tls
        )
    connections: list[Client] = []

    async def publish(topic: str, payload: bytes) -> None:
        def send() -> None:
            if not connections:
                connections.append(broker.service())
                broker.closers.append(connections[0].close)
            connections[0].publish_acknowledged(topic, payload)

        await asyncio.to_thread(send)

    return TokenBrokerAccess(signer=lambda: broker.key, publish=publish)


@contextlib.contextmanager
def _running_loop() -> Iterator[asyncio.AbstractEventLoop]:
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        yield loop
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


def _disable_nagle(_: Any, __: Any, opened: Any) -> None:
    getattr(opened, "_socket", opened).setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
