"""From CONNECT to the end: takeover, will, keep-alive, expiry, revocation."""

import time
from itertools import pairwise

import paho.mqtt.client as paho
import pytest

from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Message, RunningBroker, Transport, wait_until
from tests.harness.network.raw_mqtt import RawConnection

PAHO_GIVES_UP_S = 5.0


@pytest.fixture
def topic(space: str) -> str:
    return f"ts/v1/{space}/arm/conn"


def test_a_rejected_connect_does_not_affect_the_existing_session(broker: RunningBroker, space: str, topic: str) -> None:
    with broker.client(f"{space}-victim", publish=(topic,), subscribe=(topic,)) as victim:
        victim.subscribe(topic)
        others = broker.issue(broker.grant(f"{space}-other"))
        for credentials in (None, others, others._replace(password="wrong")):
            assert not broker.accepts(f"{space}-victim", credentials)
        victim.publish_acknowledged(topic, b"still here")
        assert victim.receive().payload == b"still here"
        assert not victim.disconnected.is_set()


def test_after_a_takeover_only_the_new_connection_receives(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    with raw_mqtt.open_session(broker, space, credentials, transport) as old:
        old.send(raw_mqtt.subscribe_packet(topic))
        with broker.connect(space, credentials) as new:
            assert new.connected.is_set()
            assert old.closed()
            new.subscribe(topic)
            for number in range(5):
                new.publish_acknowledged(topic, b"%d" % number)
            assert new.payloads(5) == [b"0", b"1", b"2", b"3", b"4"]
            assert not new.disconnected.is_set()


# ---------------------------------------------------------------- will and keep-alive


def test_a_lost_connection_publishes_and_retains_the_will_and_a_disconnect_discards_it(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    will = Message(topic, b"offline", 1, retain=True)
    with broker.client(f"{space}-page", subscribe=(topic,)) as page:
        page.subscribe(topic)
        with broker.client(space, publish=(topic,), will=will, transport=transport) as agent:
            agent.publish_acknowledged(topic, b"online", retain=True)
        assert page.receive().payload == b"online"
        with pytest.raises(AssertionError, match="received nothing"):
            page.receive(SILENCE_S)
        with broker.client(space, publish=(topic,), will=will, transport=transport) as agent:
            agent.vanish()
            assert page.receive().payload == b"offline"
        with broker.client(f"{space}-late", subscribe=(topic,)) as late:
            late.subscribe(topic)
            assert late.receive() == Message(topic, b"offline", 1, retain=True)


def test_a_keep_alive_timeout_publishes_the_will(
    broker: RunningBroker, space: str, topic: str, transport: Transport
) -> None:
    credentials = broker.issue(broker.grant(space, publish=(topic,)))
    with (
        broker.client(f"{space}-page", subscribe=(topic,)) as page,
        RawConnection(broker.port(transport), transport) as silent,
    ):
        page.subscribe(topic)
        began = time.monotonic()
        silent.send(raw_mqtt.connect_with_will(space, credentials, topic, b"offline", keep_alive_s=1))
        assert silent.read() == raw_mqtt.ACCEPTED
        assert page.receive().payload == b"offline"
        assert time.monotonic() - began > 1.0, "the timeout is 1.5 times the keep-alive"
        assert silent.closed()


def test_pings_keep_a_silent_client_alive(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space))
    for keep_alive_s in (1, 2, 4, 8, 16):
        sent_s = [time.monotonic()]
        with raw_mqtt.open_session(broker, space, credentials, keep_alive_s=keep_alive_s) as silent:
            responses = []
            while sent_s[-1] - sent_s[0] < 2 * keep_alive_s and None not in responses:
                time.sleep(0.5)
                sent_s.append(time.monotonic())
                silent.send(raw_mqtt.PINGREQ)
                responses.append(silent.read())
        if max(after - before for before, after in pairwise(sent_s)) < keep_alive_s:
            assert responses == [(raw_mqtt.PINGRESP, 0, b"")] * (len(sent_s) - 1)
            return
        # The machine was too slow: retry with a longer keep-alive.
    pytest.fail("the machine is too slow for a keep-alive of 16 s")


# ---------------------------------------------------------------- expiry and revocation


def test_expired_credentials_are_rejected(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space, lifetime_s=-1))
    broker.expire()
    assert not broker.accepts(space, credentials)


def test_expiry_ends_the_live_session(broker: RunningBroker, space: str) -> None:
    with broker.client(f"{space}-longer") as other:
        grant, short = broker.short_lived(space)

        def ended() -> bool:
            broker.expire()
            return short.disconnected.is_set()

        with short:
            wait_until(ended, "the end of a session whose credentials expired")
        assert time.time() >= grant.expires_at
        assert not other.disconnected.is_set()


def test_revoking_a_client_id_closes_and_rejects_it(broker: RunningBroker, space: str, transport: Transport) -> None:
    credentials, unused = (broker.issue(broker.grant(space)) for _ in range(2))
    with (
        broker.connect(space, credentials, transport=transport) as client,
        broker.client(f"{space}-bystander") as bystander,
    ):
        broker.revoke(client_id=space)
        assert client.ended()
        for revoked in (credentials, unused):
            assert not broker.accepts(space, revoked)
        assert broker.accepts(space, broker.issue(broker.grant(space)))
        assert not bystander.disconnected.is_set()


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ("account:{space}:s1", {"s1", "s1:watch"}),
        ("account:{space}:+:watch", {"s1:watch", "s2:watch"}),
        ("account:{space}", {"s1", "s1:watch", "s2:watch"}),
        ("account:{space}:s1:watch", {"s1:watch"}),
        ("account:{space}:s", set()),
        ("account:+", {"s1", "s1:watch", "s2:watch", "other"}),
    ],
)
def test_revoking_a_principal_closes_and_rejects_the_sessions_that_it_covers(
    broker: RunningBroker, space: str, named: str, expected: set[str]
) -> None:
    principals = {name: f"account:{space}:{name}" for name in ("s1", "s1:watch", "s2:watch")}
    principals["other"] = f"account:{space}-other:s1:watch"
    ids = {name: f"{space}-{number}" for number, name in enumerate(principals)}
    issued = {
        name: broker.issue(broker.grant(ids[name], principal=principal)) for name, principal in principals.items()
    }
    clients = {name: broker.connect(ids[name], issued[name]) for name in principals}
    broker.revoke(principal=named.format(space=space))
    for name in expected:
        assert clients[name].ended(), name
    assert {name for name, client in clients.items() if client.disconnected.is_set()} == expected
    for name, client in clients.items():
        client.close()
        assert broker.accepts(ids[name], issued[name]) == (name not in expected)
        assert broker.accepts(ids[name], broker.issue(broker.grant(ids[name], principal=principals[name])))


def test_renewing_credentials_keeps_the_connection(broker: RunningBroker, space: str) -> None:
    with broker.client(space) as client:
        broker.issue(broker.grant(space))
        assert not client.disconnected.wait(SILENCE_S)


def test_messages_to_offline_clients_are_not_retained(broker: RunningBroker, space: str, topic: str) -> None:
    credentials = broker.issue(broker.grant(space, subscribe=(topic,)))
    subscribed = (raw_mqtt.SUBACK, 0, b"\0\1\1")
    with broker.client(f"{space}-agent", publish=(topic,)) as agent:
        with raw_mqtt.open_session(broker, space, credentials, clean=False) as away:
            away.send(raw_mqtt.subscribe_packet(topic, qos=1))
            assert away.read() == subscribed
        for number in range(20):
            agent.publish_acknowledged(topic, b"%d" % number)
        with RawConnection(broker.tcp_port) as back:
            back.send(raw_mqtt.connect_packet(space, credentials, clean=False))
            response = back.read()
            assert response is not None
            assert response[0] == raw_mqtt.CONNACK
            session_present = bool(response[2][0])
            agent.publish_acknowledged(topic, b"end")
            if not session_present:
                back.send(raw_mqtt.subscribe_packet(topic, qos=1))
                assert back.read() == subscribed
                agent.publish_acknowledged(topic, b"end")
            numbers = []
            while (packet := back.read()) and not packet[2].endswith(b"end"):
                assert packet[0] == raw_mqtt.PUBLISH
                assert not packet[1] & 1, "nothing was retained"
                body = packet[2][len(raw_mqtt.text(topic)) :]
                numbers.append(int(body[2:]))
                back.send(raw_mqtt.packet(raw_mqtt.PUBACK, body[:2]))
            assert all(first < second for first, second in pairwise(numbers))
            assert session_present or numbers == [], "without a session nothing may be queued"


# ---------------------------------------------------------------- protocol versions


def test_a_client_that_starts_with_mqtt_5_ends_up_connected(broker: RunningBroker, space: str, topic: str) -> None:
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    began = time.monotonic()
    client = broker.connect(space, credentials, protocol=paho.MQTTv5)
    if not client.connected.is_set():
        assert client.answer == "Unsupported protocol version"
        assert time.monotonic() - began < PAHO_GIVES_UP_S, "no CONNACK in time"
        client.close()
        client = broker.connect(space, credentials)
    with client:
        client.subscribe(topic)
        client.publish_acknowledged(topic, b"here")
        assert client.receive().payload == b"here"


@pytest.mark.parametrize("level", [3, 5, 6, 255])
def test_another_protocol_version_is_rejected_immediately(broker: RunningBroker, space: str, level: int) -> None:
    with RawConnection(broker.tcp_port) as raw:
        raw.send(raw_mqtt.connect_packet(space, broker.issue(broker.grant(space)), level=level))
        response = raw.read()
        if broker.kind == "amqtt":
            assert response == (raw_mqtt.CONNACK, 0, b"\0\1")
        assert response is None or response[0] == raw_mqtt.CONNACK
