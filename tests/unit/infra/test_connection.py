"""Limits of one client, with a recording transport; tests/contract/brokers uses real sockets."""

import asyncio
import json
import time
from pathlib import Path

import pytest

from device_agent.protocol.security import grants, signing
from device_agent.protocol.security.grants import Grant
from function_app.ports.broker_access import Credentials
from infra.embedded_broker.broker import TelescopeBroker
from infra.embedded_broker.connection import Connection
from infra.embedded_broker.limits import Limits
from infra.embedded_broker.public_keys import KeyRing
from infra.embedded_broker.revocations import Revocations
from tests.harness.network import raw_mqtt

TOPIC = "ts/v1/s/a/conn"


class RecordingTransport:
    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.congested = False
        self.unsent = 0
        self.closed = False
        self.refusal = b""

    def admitted(self) -> None:
        """Limits of a listener do not apply here."""

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def close(self) -> None:
        self.closed = True

    abort = close


class Harness:
    """A broker without listeners, and its clients."""

    def __init__(self, folder: Path, **limits: int) -> None:
        self._key = signing.generate()
        public = self._key.public_key()
        (folder / "keys").write_text(json.dumps({signing.key_id(public): signing.public_text(public)}))
        self.keys = KeyRing(folder / "keys")
        self.keys.refresh()
        self.revocations = Revocations(folder / "revoked", lifetime_s=lambda _: 1)
        self.broker = asyncio.run(self._create(Limits(**limits)))

    async def _create(self, limits: Limits) -> TelescopeBroker:
        return TelescopeBroker(sockets={}, keys=self.keys, revocations=self.revocations, limits=limits)

    def issue(self, client_id: str, principal: str = "p") -> Credentials:
        rights, expires_at = ("ts/#",), int(time.time()) + 60
        grant = Grant(
            principal=principal,
            client_id=client_id,
            publish=rights,
            subscribe=rights,
            token_id="t",
            expires_at=expires_at,
        )
        return Credentials(principal, grants.issue(grant, self._key))

    def client(
        self, client_id: str, *subscriptions: str, qos: int = 1, principal: str = "p"
    ) -> tuple[RecordingTransport, Connection]:
        transport = RecordingTransport()
        connection = self.broker._connected(transport)
        connection.received(raw_mqtt.connect_packet(client_id, self.issue(client_id, principal)))
        transport.refusal = b"".join(transport.written) if transport.closed else b""
        if subscriptions:
            connection.received(raw_mqtt.subscribe_packet(*subscriptions, qos=qos))
        transport.written.clear()
        return transport, connection

    def publish(self, payload: bytes, *, qos: int = 1, retain: bool = False) -> None:
        self.broker.publish(TOPIC, payload, qos=qos, retain=retain, owner="x")


def test_agents_can_connect_when_the_other_clients_have_reached_their_limit(tmp_path: Path) -> None:
    harness = Harness(tmp_path, connections=10)
    pages = [harness.client(f"page{number}", principal="account:p")[0] for number in range(10)]
    assert [transport.closed for transport in pages] == [False] * 9 + [True]
    assert pages[9].refusal == raw_mqtt.packet(raw_mqtt.CONNACK, b"\0\3")
    assert not harness.client("agent", principal="agent:a")[0].closed
    assert harness.client("other", principal="agent:b")[0].closed
    assert not harness.client("agent", principal="agent:a")[0].closed, "an agent replaces its own connection"


def test_a_will_at_qos_2_is_refused_with_a_connack_and_logged_with_the_client(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    harness = Harness(tmp_path)
    transport = RecordingTransport()
    packet = bytearray(raw_mqtt.connect_with_will("client", harness.issue("client"), TOPIC, b"x", keep_alive_s=60))
    flags = packet.index(b"MQTT") + 5
    packet[flags] |= 0x10
    packet[flags] &= ~0x08
    harness.broker._connected(transport).received(bytes(packet))
    assert transport.written == [raw_mqtt.packet(raw_mqtt.CONNACK, b"\0\5")]
    assert transport.closed
    assert "CONNECT as 'client' refused: the will has QoS 2; the maximum is 1" in caplog.text


def test_qos_1_messages_are_queued_in_order_until_acknowledged(tmp_path: Path) -> None:
    harness = Harness(tmp_path, inflight=2)
    transport, client = harness.client("slow", TOPIC)
    for number in range(5):
        harness.publish(b"%d" % number)
    assert len(transport.written) == 2
    for packet_id in range(1, 4):
        client.received(raw_mqtt.packet(4, packet_id.to_bytes(2)))
    assert [packet[-1:] for packet in transport.written] == [b"0", b"1", b"2", b"3", b"4"]


@pytest.mark.parametrize("limits", [{"queued": 3}, {"queued_bytes": 3}])
def test_a_full_queue_closes_the_connection(tmp_path: Path, limits: dict[str, int]) -> None:
    harness = Harness(tmp_path, inflight=1, **limits)
    transport, _ = harness.client("slow", TOPIC)
    for _ in range(1 + 3):
        harness.publish(b"x")
    assert not transport.closed
    harness.publish(b"x")
    assert transport.closed


def test_a_congested_client_loses_qos_0_but_not_retained_messages(tmp_path: Path) -> None:
    harness = Harness(tmp_path)
    transport, client = harness.client("slow", TOPIC, qos=0)
    transport.congested = True
    harness.publish(b"lost", qos=0)
    transport.congested = False
    client.drained()
    harness.publish(b"sent", qos=0)
    assert [packet[-4:] for packet in transport.written] == [b"sent"]
    harness.publish(b"state", retain=True)
    transport, client = harness.client("other")
    transport.congested = True
    client.received(raw_mqtt.subscribe_packet(TOPIC))
    assert len(transport.written) == 1, "the SUBACK only"
    transport.congested = False
    client.drained()
    assert transport.written[1].endswith(b"state")


def test_a_client_that_never_reads_is_closed(tmp_path: Path) -> None:
    transport, client = Harness(tmp_path, unsent_bytes=100).client("client")
    transport.unsent = 101
    client.received(raw_mqtt.PINGREQ)
    assert transport.closed


def test_filters_are_limited_per_subscribe_and_per_client(tmp_path: Path) -> None:
    transport, client = Harness(tmp_path, filters_per_subscribe=8, filters_per_client=10).client("client")
    for first, count in ((0, 8), (6, 6)):
        client.received(raw_mqtt.subscribe_packet(*(f"ts/{first + number}" for number in range(count))))
    assert transport.written == [
        raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(8)),
        raw_mqtt.packet(raw_mqtt.SUBACK, b"\0\1" + bytes(4) + b"\x80\x80"),
    ]
    client.received(raw_mqtt.subscribe_packet(*(f"ts/{number}" for number in range(9))))
    assert transport.closed


def test_too_many_retained_topics_close_the_connection(tmp_path: Path) -> None:
    transport, client = Harness(tmp_path, retained_per_client=2).client("client")
    for number in range(3):
        assert not transport.closed
        client.received(raw_mqtt.publish_packet(f"ts/{number}", b"x", retain=True))
    assert transport.closed


def test_the_keep_alive_timeout_is_one_and_a_half_intervals(tmp_path: Path) -> None:
    transport, client = Harness(tmp_path).client("client")
    client.tick(1_000.0, time.time())
    client.tick(1_089.0, time.time())
    assert not transport.closed
    client.received(raw_mqtt.PINGREQ)
    client.tick(1_091.0, time.time())
    assert not transport.closed
    client.tick(1_182.0, time.time())
    assert transport.closed


def test_a_lost_connection_leaves_no_state(tmp_path: Path) -> None:
    harness = Harness(tmp_path)
    _, client = harness.client("client", TOPIC, "ts/#")
    client.lost()
    client.lost()
    assert not harness.broker._connections
    assert not harness.broker._clients
    assert harness.broker._subscriptions_table.subscribers(TOPIC) == ()
