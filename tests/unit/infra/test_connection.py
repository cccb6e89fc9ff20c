"""The bounds of one client, with a link that records instead of a socket; tests/contract/brokers has real ones."""

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
from infra.embedded_broker.listeners import TcpLink, WebSocketLink
from infra.embedded_broker.public_keys import KeyRing
from infra.embedded_broker.revocations import Revocations
from tests.harness.network import raw_mqtt
from tests.harness.network.raw_mqtt import Wire

TOPIC = "ts/v1/s/a/conn"
Attached = tuple["Link", Connection]


class Link:
    """Where the broker writes to."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.congested = False
        self.unsent = 0
        self.gone = False

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def close(self) -> None:
        self.gone = True

    def abort(self) -> None:
        self.gone = True


class Bench:
    """A broker that does not listen, and clients of it."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self._key = signing.generate()
        public = self._key.public_key()
        (folder / "keys").write_text(json.dumps({signing.key_id(public): signing.public_text(public)}))
        keys = KeyRing(folder / "keys")
        keys.refresh()
        self.broker = TelescopeBroker(
            sockets={}, keys=keys, revocations=Revocations(folder / "revoked", keep_s=1), limits=limits
        )

    def credentials(self, client_id: str) -> Credentials:
        grant = Grant(
            principal="p",
            client_id=client_id,
            publish=("ts/#",),
            subscribe=("ts/#",),
            token_id=client_id,
            expires_at=int(time.time()) + 60,
        )
        return Credentials("p", grants.issue(grant, self._key))

    def client(self, client_id: str, *subscriptions: str, qos: int = 1) -> Attached:
        link = Link()
        connection = self.broker._connected(link)
        connection.received(raw_mqtt.connect_packet(client_id, self.credentials(client_id)))
        if subscriptions:
            connection.received(raw_mqtt.subscribe_packet(*subscriptions, qos=qos))
        link.written.clear()
        return link, connection


def with_bench(folder: Path, use: Callable[[Bench], None], **limits: int) -> None:
    async def run() -> None:
        use(Bench(folder, Limits(**limits)))

    asyncio.run(run())


def test_more_connections_than_there_may_be_are_closed_and_the_others_live(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        first, _ = bench.client("first")
        second, _ = bench.client("second")
        third, _ = bench.client("third")
        assert (first.gone, second.gone, third.gone) == (False, False, True)
        second_again, _ = bench.client("second")
        assert second_again.gone

    with_bench(tmp_path, use, connections=2)


def test_qos_1_waits_for_a_client_that_acknowledges_late_and_keeps_its_order(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, slow = bench.client("slow", TOPIC)
        for number in range(5):
            bench.broker.publish(TOPIC, b"%d" % number, qos=1, retain=False, owner="x")
        assert len(link.written) == 2
        for packet_id in range(1, 4):
            slow.received(raw_mqtt.packet(4, packet_id.to_bytes(2)))
        assert [packet[-1:] for packet in link.written] == [b"0", b"1", b"2", b"3", b"4"]

    with_bench(tmp_path, use, inflight=2)


@pytest.mark.parametrize("limits", [{"waiting": 3}, {"waiting_bytes": 3}])
def test_a_client_that_falls_too_far_behind_is_cut_off_rather_than_lied_to(
    tmp_path: Path, limits: dict[str, int]
) -> None:
    def use(bench: Bench) -> None:
        link, _ = bench.client("slow", TOPIC)
        for _ in range(1 + 3):
            bench.broker.publish(TOPIC, b"x", qos=1, retain=False, owner="x")
        assert not link.gone
        bench.broker.publish(TOPIC, b"x", qos=1, retain=False, owner="x")
        assert link.gone

    with_bench(tmp_path, use, inflight=1, **limits)


def test_qos_0_is_dropped_for_a_congested_client_and_comes_again_afterwards(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, slow = bench.client("slow", TOPIC, qos=0)
        link.congested = True
        bench.broker.publish(TOPIC, b"lost", qos=0, retain=False, owner="x")
        link.congested = False
        slow.drained()
        bench.broker.publish(TOPIC, b"here", qos=0, retain=False, owner="x")
        assert [packet[-4:] for packet in link.written] == [b"here"]

    with_bench(tmp_path, use)


def test_retained_messages_wait_for_a_congested_client(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        bench.broker.publish(TOPIC, b"state", qos=1, retain=True, owner="x")
        link, slow = bench.client("slow")
        link.congested = True
        slow.received(raw_mqtt.subscribe_packet(TOPIC))
        assert len(link.written) == 1, "the SUBACK only"
        link.congested = False
        slow.drained()
        assert link.written[1].endswith(b"state")

    with_bench(tmp_path, use)


def test_a_client_that_asks_and_never_reads_is_cut_off(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, rude = bench.client("rude")
        link.unsent = 101
        rude.received(raw_mqtt.PINGREQ)
        assert link.gone

    with_bench(tmp_path, use, unsent_bytes=100)


def test_filters_are_bounded_in_one_subscribe_and_for_one_client(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, greedy = bench.client("greedy")
        greedy.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(8))))
        greedy.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(6, 12))))
        assert link.written == [
            raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(8)),
            raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(4) + b"\x80\x80"),
        ]
        greedy.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(9))))
        assert link.gone

    with_bench(tmp_path, use, filters_per_subscribe=8, filters_per_client=10)


def test_more_retained_topics_than_a_clients_share_end_its_connection(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, greedy = bench.client("greedy")
        for number in range(3):
            assert not link.gone
            greedy.received(raw_mqtt.publish_packet(f"ts/{number}", b"x", retain=True))
        assert link.gone

    with_bench(tmp_path, use, retained_per_client=2)


def test_a_client_that_sends_no_connect_is_cut_off_in_the_end(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link = Link()
        idle = bench.broker._connected(link)
        now_s = asyncio.get_running_loop().time()
        idle.received(b"\x10")
        idle.tick(now_s + 9, time.time())
        assert not link.gone
        idle.tick(now_s + 11, time.time())
        assert link.gone

    with_bench(tmp_path, use)


def test_a_client_may_be_silent_for_one_and_a_half_times_its_keep_alive(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        link, client = bench.client("client")
        client.tick(1_000.0, time.time())
        client.tick(1_089.0, time.time())
        assert not link.gone
        client.received(raw_mqtt.PINGREQ)
        client.tick(1_091.0, time.time())
        assert not link.gone
        client.tick(1_182.0, time.time())
        assert link.gone

    with_bench(tmp_path, use)


def test_nothing_of_a_client_is_left_when_it_is_gone(tmp_path: Path) -> None:
    def use(bench: Bench) -> None:
        _, client = bench.client("client", TOPIC, "ts/#")
        client.lost()
        client.lost()
        assert not bench.broker._connections
        assert not bench.broker._clients
        assert bench.broker._subscriptions_table.hearers(TOPIC) == ()

    with_bench(tmp_path, use)


@pytest.mark.parametrize("transport", ["tcp", "websockets"])
def test_every_accepted_socket_has_nagles_algorithm_switched_off(tmp_path: Path, transport: str) -> None:
    """The option itself; that it is felt is measured against both brokers in tests/contract/brokers."""
    seen: list[int] = []
    accepted = asyncio.Event()

    class Watched(TelescopeBroker):
        def _connected(self, link: TcpLink | WebSocketLink) -> Connection:  # type: ignore[override]
            carrier = link._transport if isinstance(link, TcpLink) else link._websocket.transport
            assert carrier is not None
            opened = carrier.get_extra_info("socket")
            seen.append(opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            accepted.set()
            return super()._connected(link)

    async def run() -> None:
        bench = Bench(tmp_path, Limits())
        sockets = {name: socket.create_server(("127.0.0.1", 0)) for name in (TCP, WEBSOCKET)}
        port = sockets[TCP if transport == "tcp" else WEBSOCKET].getsockname()[1]
        broker = Watched(sockets=sockets, keys=bench.broker._keys, revocations=bench.broker._revocations)
        await broker.start()
        connected = await asyncio.to_thread(Wire, port, transport)  # type: ignore[arg-type]
        await accepted.wait()
        await broker.shutdown()
        await asyncio.to_thread(connected.close)

    asyncio.run(run())
    assert seen == [1]
