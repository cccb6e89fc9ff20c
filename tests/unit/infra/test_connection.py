"""Limits of one client, with a recording transport; tests/contract/brokers uses real sockets."""

import asyncio
import json
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import Credentials
from infra.embedded_broker.broker import TCP, WEBSOCKET, TelescopeBroker
from infra.embedded_broker.connection import Connection
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.listeners import TcpTransport, WebSocketTransport
from infra.embedded_broker.public_keys import KeyRing
from infra.embedded_broker.revocations import Revocations
from tests.harness.network import raw_mqtt
from tests.harness.network.raw_mqtt import RawConnection

TOPIC = "ts/v1/s/a/conn"


class RecordingTransport:
    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.congested = False
        self.unsent = 0
        self.closed = False

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def close(self) -> None:
        self.closed = True

    abort = close


class Harness:
    """A broker without listeners, and its clients."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self._key = signing.generate()
        public = self._key.public_key()
        (folder / "keys").write_text(json.dumps({signing.key_id(public): signing.public_text(public)}))
        keys = KeyRing(folder / "keys")
        keys.refresh()
        self.broker = TelescopeBroker(
            sockets={}, keys=keys, revocations=Revocations(folder / "revoked", keep_s=1), limits=limits
        )

    def client(self, client_id: str, *subscriptions: str, qos: int = 1) -> tuple[RecordingTransport, Connection]:
        grant = Grant(
            principal="p",
            client_id=client_id,
            publish=("ts/#",),
            subscribe=("ts/#",),
            token_id=client_id,
            expires_at=int(time.time()) + 60,
        )
        transport = RecordingTransport()
        connection = self.broker._connected(transport)
        credentials = Credentials("p", grants.issue(grant, self._key))
        connection.received(raw_mqtt.connect_packet(client_id, credentials))
        if subscriptions:
            connection.received(raw_mqtt.subscribe_packet(*subscriptions, qos=qos))
        transport.written.clear()
        return transport, connection

    def publish(self, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        self.broker.publish(TOPIC, payload, qos=qos, retain=retain, owner="x")


@pytest.fixture
def with_harness(tmp_path: Path) -> Callable[..., None]:
    def run(use: Callable[[Harness], None], **limits: int) -> None:
        async def in_loop() -> None:
            use(Harness(tmp_path, Limits(**limits)))

        asyncio.run(in_loop())

    return run


def test_connections_above_the_limit_are_closed(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transports = [harness.client(name)[0] for name in ("first", "second", "third", "second")]
        assert [transport.closed for transport in transports] == [False, False, True, True]

    with_harness(use, connections=2)


def test_qos_1_messages_are_queued_in_order_until_acknowledged(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, slow = harness.client("slow", TOPIC)
        for number in range(5):
            harness.publish(b"%d" % number)
        assert len(transport.written) == 2
        for packet_id in range(1, 4):
            slow.received(raw_mqtt.packet(4, packet_id.to_bytes(2)))
        assert [packet[-1:] for packet in transport.written] == [b"0", b"1", b"2", b"3", b"4"]

    with_harness(use, inflight=2)


@pytest.mark.parametrize("limits", [{"queued": 3}, {"queued_bytes": 3}])
def test_a_full_queue_closes_the_connection(with_harness: Callable[..., None], limits: dict[str, int]) -> None:
    def use(harness: Harness) -> None:
        transport, _ = harness.client("slow", TOPIC)
        for _ in range(1 + 3):
            harness.publish(b"x")
        assert not transport.closed
        harness.publish(b"x")
        assert transport.closed

    with_harness(use, inflight=1, **limits)


def test_a_congested_client_loses_qos_0_but_not_retained_messages(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, slow = harness.client("slow", TOPIC, qos=0)
        transport.congested = True
        harness.publish(b"lost", qos=0)
        transport.congested = False
        slow.drained()
        harness.publish(b"sent", qos=0)
        assert [packet[-4:] for packet in transport.written] == [b"sent"]
        harness.publish(b"state", retain=True)
        transport, slow = harness.client("other")
        transport.congested = True
        slow.received(raw_mqtt.subscribe_packet(TOPIC))
        assert len(transport.written) == 1, "the SUBACK only"
        transport.congested = False
        slow.drained()
        assert transport.written[1].endswith(b"state")

    with_harness(use)


def test_a_client_that_never_reads_is_closed(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, client = harness.client("client")
        transport.unsent = 101
        client.received(raw_mqtt.PINGREQ)
        assert transport.closed

    with_harness(use, unsent_bytes=100)


def test_filters_are_limited_per_subscribe_and_per_client(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, client = harness.client("client")
        client.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(8))))
        client.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(6, 12))))
        assert transport.written == [
            raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(8)),
            raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(4) + b"\x80\x80"),
        ]
        client.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(9))))
        assert transport.closed

    with_harness(use, filters_per_subscribe=8, filters_per_client=10)


def test_too_many_retained_topics_close_the_connection(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, client = harness.client("client")
        for number in range(3):
            assert not transport.closed
            client.received(raw_mqtt.publish_packet(f"ts/{number}", b"x", retain=True))
        assert transport.closed

    with_harness(use, retained_per_client=2)


def test_a_client_without_connect_times_out(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport = RecordingTransport()
        idle = harness.broker._connected(transport)
        now_s = asyncio.get_running_loop().time()
        idle.received(b"\x10")
        idle.tick(now_s + 9, time.time())
        assert not transport.closed
        idle.tick(now_s + 11, time.time())
        assert transport.closed

    with_harness(use)


def test_the_keep_alive_timeout_is_one_and_a_half_intervals(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        transport, client = harness.client("client")
        client.tick(1_000.0, time.time())
        client.tick(1_089.0, time.time())
        assert not transport.closed
        client.received(raw_mqtt.PINGREQ)
        client.tick(1_091.0, time.time())
        assert not transport.closed
        client.tick(1_182.0, time.time())
        assert transport.closed

    with_harness(use)


def test_a_lost_connection_leaves_no_state(with_harness: Callable[..., None]) -> None:
    def use(harness: Harness) -> None:
        _, client = harness.client("client", TOPIC, "ts/#")
        client.lost()
        client.lost()
        assert not harness.broker._connections
        assert not harness.broker._clients
        assert harness.broker._subscriptions_table.subscribers(TOPIC) == ()

    with_harness(use)


@pytest.mark.parametrize("kind", ["tcp", "websockets"])
def test_accepted_sockets_have_tcp_nodelay(tmp_path: Path, kind: str) -> None:
    options: list[int] = []
    accepted = asyncio.Event()

    class ObservedBroker(TelescopeBroker):
        def _connected(self, transport: TcpTransport | WebSocketTransport) -> Connection:  # type: ignore[override]
            inner = transport._transport if isinstance(transport, TcpTransport) else transport._websocket.transport
            assert inner is not None
            options.append(inner.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            accepted.set()
            return super()._connected(transport)

    async def run() -> None:
        harness = Harness(tmp_path, Limits())
        sockets = {name: socket.create_server(("127.0.0.1", 0)) for name in (TCP, WEBSOCKET)}
        port = sockets[TCP if kind == "tcp" else WEBSOCKET].getsockname()[1]
        broker = ObservedBroker(sockets=sockets, keys=harness.broker._keys, revocations=harness.broker._revocations)
        await broker.start()
        client = await asyncio.to_thread(RawConnection, port, kind)  # type: ignore[arg-type]
        await accepted.wait()
        await broker.shutdown()
        await asyncio.to_thread(client.close)

    asyncio.run(run())
    assert options == [1]
