"""From CONNECT to the end: takeover, will, keep-alive, expiry, revocation."""

import time
from itertools import pairwise

import paho.mqtt.client as paho
import pytest

from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Message, RunningBroker, Transport, wait_until
from tests.harness.network.raw_mqtt import RawConnection


def test_a_rejected_connect_does_not_affect_the_existing_session(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with (
        broker.client(f"{space}-victim", publish=(topic,), subscribe=(topic,)) as victim,
    ):
        victim.subscribe(topic)
        others = broker.issue(broker.grant(f"{space}-other"))
        for credentials in (None, others, others._replace(password="wrong")):
            with broker.connect(f"{space}-victim", credentials) as thief:
                assert not thief.connected.is_set()
        victim.publish_acknowledged(topic, b"still here")
        assert victim.receive().payload == b"still here"
        assert not victim.disconnected.is_set()


def test_a_takeover_closes_the_old_socket(broker: RunningBroker, space: str, transport: Transport) -> None:
    credentials = broker.issue(broker.grant(space))
    with RawConnection(broker.port(transport), transport) as old:
        old.send(raw_mqtt.connect_packet(space, credentials))
        assert old.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
        with broker.connect(space, credentials) as new:
            assert new.connected.is_set()
            assert old.closed()
            assert not new.disconnected.is_set()


def test_after_a_takeover_only_the_new_connection_receives(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    with broker.connect(space, credentials) as old:
        old.subscribe(topic)
        with broker.connect(space, credentials) as new:
            wait_until(old.disconnected.is_set, "the end of the old connection")
            new.subscribe(topic)
            for number in range(5):
                new.publish_acknowledged(topic, b"%d" % number)
            assert [new.receive().payload for _ in range(5)] == [b"0", b"1", b"2", b"3", b"4"]
            assert old.pending() == []


def test_a_lost_connection_publishes_and_retains_the_will(
    broker: RunningBroker, space: str, transport: Transport
) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    will = Message(topic, b"offline", 1, retain=True)
    with broker.client(f"{space}-page", subscribe=(topic,)) as page:
        page.subscribe(topic)
        with broker.client(space, publish=(topic,), will=will, transport=transport) as agent:
            agent.publish_acknowledged(topic, b"online", retain=True)
            assert page.receive().payload == b"online"
            agent.vanish()
            assert page.receive().payload == b"offline"
        with broker.client(f"{space}-late", subscribe=(topic,)) as late:
            late.subscribe(topic)
            assert late.receive() == Message(topic, b"offline", 1, retain=True)


def test_a_keep_alive_timeout_publishes_the_will(broker: RunningBroker, space: str, transport: Transport) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    credentials = broker.issue(broker.grant(space, publish=(topic,)))
    with (
        broker.client(f"{space}-page", subscribe=(topic,)) as page,
        RawConnection(broker.port(transport), transport) as silent,
    ):
        page.subscribe(topic)
        began = time.monotonic()
        silent.send(raw_mqtt.connect_with_will(space, credentials, topic, b"offline", keep_alive_s=1))
        assert silent.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
        assert page.receive().payload == b"offline"
        assert time.monotonic() - began > 1.0, "a client may be silent for its keep-alive and half of it again"
        assert silent.closed()


def test_pings_keep_a_silent_client_alive(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space))
    for keep_alive_s in (1, 2, 4, 8, 16):
        with RawConnection(broker.tcp_port) as silent:
            said_s = [time.monotonic()]
            silent.send(raw_mqtt.connect_packet(space, credentials, keep_alive_s=keep_alive_s))
            answers = [silent.read()]
            while said_s[-1] - said_s[0] < 2 * keep_alive_s and answers[-1] is not None:
                time.sleep(0.5)
                said_s.append(time.monotonic())
                silent.send(raw_mqtt.PINGREQ)
                answers.append(silent.read())
        if max(after - before for before, after in pairwise(said_s)) < keep_alive_s:
            assert answers == [(raw_mqtt.CONNACK, 0, b"\0\0"), *[(raw_mqtt.PINGRESP, 0, b"")] * (len(said_s) - 1)]
            return
        # The machine was too slow: retry with a longer keep-alive.
    pytest.fail("the machine is too slow for a keep-alive of 16 s")


def test_a_disconnect_discards_the_will(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with broker.client(f"{space}-page", subscribe=(topic,)) as page:
        page.subscribe(topic)
        with broker.client(space, publish=(topic,), will=Message(topic, b"offline", 1, retain=True)) as agent:
            agent.publish_acknowledged(topic, b"online")
        assert page.receive().payload == b"online"
        with pytest.raises(AssertionError, match="received nothing"):
            page.receive(SILENCE_S)


def test_expired_credentials_are_rejected(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space, lifetime_s=-1))
    broker.expire()
    with broker.connect(space, credentials) as late:
        assert not late.connected.is_set()


def test_expiry_ends_the_live_session(broker: RunningBroker, space: str) -> None:
    with broker.client(f"{space}-longer") as other:
        grant, short = broker.short_lived(space)

        def ended() -> bool:
            broker.expire()
            return short.disconnected.is_set()

        with short:
            wait_until(ended, "the end of a session whose credentials ran out")
        assert time.time() >= grant.expires_at
        assert not other.disconnected.is_set()


def test_revoking_a_client_id_closes_and_rejects_it(broker: RunningBroker, space: str, transport: Transport) -> None:
    credentials, spare = (broker.issue(broker.grant(space)) for _ in range(2))
    with (
        broker.connect(space, credentials, transport=transport) as client,
        broker.client(f"{space}-bystander") as bystander,
    ):
        broker.revoke(client_id=space)
        wait_until(client.disconnected.is_set, "the end of a revoked session")
        for revoked in (credentials, spare):  # the spare one is unused
            with broker.connect(space, revoked) as again:
                assert not again.connected.is_set()
        with broker.connect(space, broker.issue(broker.grant(space))) as renewed:
            assert renewed.connected.is_set()
            assert not bystander.disconnected.is_set()


def test_revoking_a_principal_closes_its_sessions_only(broker: RunningBroker, space: str) -> None:
    person = f"account:{space}"
    ids = [f"{space}-watch", f"{space}-control"]
    credentials = [broker.issue(broker.grant(each, principal=person)) for each in ids]
    with broker.client(f"{space}-other") as other:
        clients = [broker.connect(each, given) for each, given in zip(ids, credentials, strict=True)]
        broker.revoke(principal=person)
        for client in clients:
            wait_until(client.disconnected.is_set, "the end of a revoked session")
            client.close()
        for each, given in zip(ids, credentials, strict=True):
            with broker.connect(each, given) as again:
                assert not again.connected.is_set()
        with broker.connect(ids[0], broker.issue(broker.grant(ids[0], principal=person))) as renewed:
            assert renewed.connected.is_set()
        assert not other.disconnected.is_set()


@pytest.mark.parametrize(
    ("named", "cut"),
    [
        ("account:{a}:s1", {"a1", "a1w"}),
        ("account:{a}:+:watch", {"a1w", "a2w"}),
        ("account:{a}", {"a1", "a1w", "a2w"}),
        ("account:{a}:s1:watch", {"a1w"}),
        ("account:{a}:s", set()),
        ("account:+", {"a1", "a1w", "a2w", "b1w"}),
    ],
)
def test_a_principal_stands_for_what_is_part_of_it_and_plus_for_any_one_part(
    broker: RunningBroker, space: str, named: str, cut: set[str]
) -> None:
    a, b = f"{space}a", f"{space}b"
    principals = {
        "a1": f"account:{a}:s1",
        "a1w": f"account:{a}:s1:watch",
        "a2w": f"account:{a}:s2:watch",
        "b1w": f"account:{b}:s1:watch",
    }
    clients = {
        name: broker.connect(f"{space}-{name}", broker.issue(broker.grant(f"{space}-{name}", principal=principal)))
        for name, principal in principals.items()
    }
    broker.revoke(principal=named.format(a=a))
    for name in cut:
        wait_until(clients[name].disconnected.is_set, f"the end of {name}")
    assert {name for name, client in clients.items() if client.disconnected.is_set()} == cut
    for client in clients.values():
        client.close()


def test_renewing_credentials_keeps_the_connection(broker: RunningBroker, space: str) -> None:
    with broker.client(space) as client:
        broker.issue(broker.grant(space))
        assert not client.disconnected.wait(SILENCE_S)


def test_messages_to_offline_clients_are_not_retained(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/ur5/event"
    credentials = broker.issue(broker.grant(space, subscribe=(topic,)))
    with broker.client(f"{space}-agent", publish=(topic,)) as agent:
        with RawConnection(broker.tcp_port) as away:
            away.send(raw_mqtt.connect_packet(space, credentials, clean=False))
            assert away.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
            away.send(raw_mqtt.subscribe_packet(topic, qos=1))
            assert away.read() == (raw_mqtt.SUBACK, 0, b"\0\1\1")
        for number in range(20):
            agent.publish_acknowledged(topic, b"%d" % number)
        with RawConnection(broker.tcp_port) as back:
            back.send(raw_mqtt.connect_packet(space, credentials, clean=False))
            answer = back.read()
            assert answer is not None
            assert answer[0] == raw_mqtt.CONNACK
            agent.publish_acknowledged(topic, b"end")
            numbers = []
            if not answer[2][0]:  # no session was kept, so nothing may be queued either
                back.send(raw_mqtt.subscribe_packet(topic, qos=1))
                assert back.read() == (raw_mqtt.SUBACK, 0, b"\0\1\1")
                agent.publish_acknowledged(topic, b"end")
            while (packet := back.read()) and not packet[2].endswith(b"end"):
                assert packet[0] == raw_mqtt.PUBLISH
                assert not packet[1] & 1, "nothing was retained"
                numbers.append(int(packet[2][len(raw_mqtt.text(topic)) + 2 :]))
                back.send(raw_mqtt.packet(raw_mqtt.PUBACK, packet[2][len(raw_mqtt.text(topic)) :][:2]))
            assert all(first < second for first, second in pairwise(numbers))
            assert answer[2][0] or numbers == []


def test_a_client_that_starts_with_mqtt_5_ends_up_connected(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
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


PAHO_GIVES_UP_S = 5.0


@pytest.mark.parametrize("level", [3, 5, 6, 255])
def test_another_protocol_version_is_rejected_immediately(broker: RunningBroker, space: str, level: int) -> None:
    with RawConnection(broker.tcp_port) as raw:
        raw.send(raw_mqtt.connect_packet(space, broker.issue(broker.grant(space)), level=level))
        answer = raw.read()
        if broker.kind == "amqtt":
            assert answer == (raw_mqtt.CONNACK, 0, b"\0\1")
        assert answer is None or answer[0] == raw_mqtt.CONNACK
