"""The embedded broker only: tokens, keys, control topic, strict rejection."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol import codec
from device_agent.protocol.security import grants, revocation, signing
from function_app.ports.broker_access import Credentials
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Message, RunningBroker, start_broker, wait_until
from tests.harness.network.raw_mqtt import RawConnection


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    with start_broker("amqtt", tmp_path_factory.mktemp("embedded")) as broker:
        yield broker


def test_a_revoked_agent_appears_offline(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with (
        broker.client(f"{space}-page", subscribe=(topic,)) as page,
        broker.client(space, publish=(topic,), will=Message(topic, b"offline", 1, retain=True)),
    ):
        page.subscribe(topic)
        broker.revoke(client_id=space)
        assert page.receive().payload == b"offline"


def test_an_agent_with_an_expired_token_appears_offline(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with broker.client(f"{space}-page", subscribe=(topic,)) as page:
        _, agent = broker.short_lived(space, publish=(topic,), will=Message(topic, b"offline", 1, retain=True))
        with agent:
            page.subscribe(topic)
            assert page.receive().payload == b"offline"


def test_one_token_can_be_revoked_alone(broker: RunningBroker, space: str) -> None:
    first, second = broker.grant(space), broker.grant(space)
    with broker.service() as functions, broker.connect(space, broker.issue(first)) as client:
        order = json.dumps({"revoke": {"token_id": first.token_id}})
        functions.publish_acknowledged(revocation.TOPIC, order)
        wait_until(client.disconnected.is_set, "the end of a revoked session")
        with broker.connect(space, broker.issue(first)) as again:
            assert not again.connected.is_set()
        with broker.connect(space, broker.issue(second)) as other:
            assert other.connected.is_set()


@pytest.mark.parametrize(
    "order",
    [
        b"",
        b"{}",
        b"null",
        b'{"revoke":{}}',
        b'{"revoke":{"client_id":"a","principal":"b"}}',
        b'{"revoke":{"all":true}}',
    ],
)
def test_an_invalid_control_message_is_not_acknowledged(broker: RunningBroker, order: bytes) -> None:
    with broker.service() as functions:
        sent = functions.publish(revocation.TOPIC, order)
        wait_until(functions.disconnected.is_set, "the end of the connection")
        assert not functions.acknowledged(sent)


def test_control_messages_are_neither_delivered_nor_retained(broker: RunningBroker, space: str) -> None:
    own = f"ts/v1/{space}/nosy/conn"
    with (
        broker.client(f"{space}-nosy", publish=(own,), subscribe=(own, revocation.TOPIC, "$CONTROL/#")) as nosy,
        broker.service() as functions,
    ):
        nosy.subscribe(revocation.TOPIC, "$CONTROL/#", own)
        functions.publish_acknowledged(revocation.TOPIC, json.dumps({"revoke": {"client_id": "unknown"}}), retain=True)
        nosy.subscribe(revocation.TOPIC)
        nosy.publish_acknowledged(own, b"end")
        assert [m.topic for m in (nosy.receive(), *nosy.pending())] == [own]


def test_a_will_cannot_use_the_control_topic(broker: RunningBroker) -> None:
    service = broker.access.service_credentials()
    will = Message(revocation.TOPIC, b'{"revoke":{"client_id":"x"}}', 1, retain=False)
    with broker.connect(service.client_id, Credentials(service.username, service.password), will=will) as functions:
        assert not functions.connected.is_set()


def test_mqtt_5_is_rejected_immediately_in_the_old_format(broker: RunningBroker, space: str) -> None:
    for credentials in (None, broker.issue(broker.grant(space))):
        with RawConnection(broker.tcp_port) as raw:
            raw.send(raw_mqtt.connect_packet(space, credentials, level=5))
            assert raw.read() == (raw_mqtt.CONNACK, 0, b"\0\1")
            assert raw.closed()


@pytest.mark.parametrize("retain", [False, True])
def test_a_denied_publish_closes_the_connection(broker: RunningBroker, space: str, *, retain: bool) -> None:
    for qos in (0, 1):
        with broker.client(space) as client:
            client.publish(f"ts/v1/{space}/arm/conn", b"x", qos=qos, retain=retain)
            wait_until(client.disconnected.is_set, "the end of the connection")


def test_qos_2_is_rejected(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    with broker.client(space, publish=(topic,), subscribe=(topic,)) as client:
        assert client.subscribe(topic, qos=2) == [1]
        client.publish(topic, b"x", qos=2)
        wait_until(client.disconnected.is_set, "the end of the connection")


def test_a_denied_filter_does_not_affect_others(broker: RunningBroker, space: str) -> None:
    mine = f"ts/v1/{space}/arm/+"
    refused = ("#", "ts/v1/+/arm/conn", f"{mine}/#", "$SYS/#", "", "ts/v1/#/conn", f"ts/v1/{space}/arm/a+", "x" * 600)
    with RawConnection(broker.tcp_port) as raw:
        raw.send(raw_mqtt.connect_packet(space, broker.issue(broker.grant(space, subscribe=(mine,)))))
        assert raw.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
        raw.send(raw_mqtt.subscribe_packet(*refused[:4], mine, *refused[4:]))
        assert raw.read() == (raw_mqtt.SUBACK, 0, b"\0\1" + b"\x80" * 4 + b"\0" + b"\x80" * 4)


def test_sessions_are_always_clean(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/conn"
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    for _ in range(2):
        with RawConnection(broker.tcp_port) as raw:
            raw.send(raw_mqtt.connect_packet(space, credentials, clean=False))
            assert raw.read() == (raw_mqtt.CONNACK, 0, b"\0\0")
            raw.send(raw_mqtt.publish_packet(topic, b"x", qos=1))
            assert raw.read() == (raw_mqtt.PUBACK, 0, b"\0\1"), "a subscription survived the session"
            raw.send(raw_mqtt.subscribe_packet(topic, qos=1))
            assert raw.read() == (raw_mqtt.SUBACK, 0, b"\0\1\1")


def test_one_byte_above_the_limit_is_rejected(broker: RunningBroker, space: str) -> None:
    with broker.client(space, publish=("t",)) as client:
        client.publish_acknowledged("t", bytes(codec.MAX_BYTES))
        client.publish("t", bytes(codec.MAX_BYTES + 1))
        wait_until(client.disconnected.is_set, "the end of the connection")


def test_an_oversized_retained_message_is_rejected(broker: RunningBroker, space: str) -> None:
    topic = f"ts/v1/{space}/arm/ur5/desc/twin"
    with broker.client(space, publish=(topic,)) as client:
        client.publish(topic, bytes(codec.MAX_RETAINED_BYTES + 1), retain=True)
        wait_until(client.disconnected.is_set, "the end of the connection")


def test_a_token_with_a_too_long_lifetime_is_rejected(broker: RunningBroker, space: str) -> None:
    with broker.connect(space, broker.issue(broker.grant(space, lifetime_s=31 * 86_400))) as client:
        assert not client.connected.is_set()


def test_the_log_names_rejected_clients_but_no_secrets(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space))
    with broker.connect(f"{space}-thief", credentials):
        pass
    said = f"CONNECT as '{space}-thief' refused: the token belongs to another client id"
    wait_until(lambda: said in broker.stderr(), "the refusal in the log")
    assert credentials.password not in broker.stderr()


def test_changed_keys_are_reloaded(tmp_path: Path) -> None:
    def write(*keys: object) -> None:
        text = json.dumps({signing.key_id(k.public_key()): signing.public_text(k.public_key()) for k in keys})  # type: ignore[attr-defined]
        new = path.with_suffix(".new")
        new.write_text(text)
        os.replace(new, path)  # noqa: PTH105 (as the functions do)

    path = tmp_path / "keys.json"
    old, new = signing.generate(), signing.generate()
    write(old)
    with start_broker("amqtt", tmp_path / "home", keys=path) as broker:
        grant = broker.grant("agent", lifetime_s=600)
        by_old, by_new = (Credentials(grant.principal, grants.issue(grant, key)) for key in (old, new))
        with broker.connect("agent", by_new) as early:
            assert not early.connected.is_set()
        write(old, new)
        with broker.connect("agent", by_new) as client:
            assert client.connected.is_set()
        with broker.connect("agent", by_old) as client:
            assert client.connected.is_set()
            path.write_text("{ not json")
            assert not client.disconnected.wait(SILENCE_S), "invalid keys must not replace the current ones"
            write(new)
            wait_until(client.disconnected.is_set, "the end of a session whose key was withdrawn")
        with broker.connect("agent", by_old) as client:
            assert not client.connected.is_set()
        assert "Traceback" not in broker.stderr()
