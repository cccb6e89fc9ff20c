"""The embedded broker only: tokens, keys, control topic, strict rejection."""

import json
from pathlib import Path

import pytest

from device_agent.protocol import codec
from device_agent.protocol.security import grants, revocation, signing
from function_app.ports.broker_access import Credentials
from tests.contract.conftest import Brokers
from tests.harness.network import raw_mqtt
from tests.harness.network.brokers import SILENCE_S, Message, RunningBroker, start_broker, wait_until
from tests.harness.network.raw_mqtt import RawConnection


@pytest.fixture
def running(brokers: Brokers) -> RunningBroker:
    return brokers("amqtt")


@pytest.fixture
def topic(space: str) -> str:
    return f"ts/v1/{space}/arm/conn"


def test_a_revoked_or_expired_agent_appears_offline(broker: RunningBroker, space: str, topic: str) -> None:
    will = Message(topic, b"offline", 1, retain=False)
    with broker.client(f"{space}-page", subscribe=(topic,)) as page:
        page.subscribe(topic)
        with broker.client(space, publish=(topic,), will=will):
            broker.revoke(client_id=space)
            assert page.receive().payload == b"offline"
        _, agent = broker.short_lived(space, publish=(topic,), will=will)
        with agent:
            assert page.receive().payload == b"offline"


def test_one_token_can_be_revoked_alone(broker: RunningBroker, space: str) -> None:
    first, second = broker.grant(space), broker.grant(space)
    with broker.service() as functions, broker.connect(space, broker.issue(first)) as client:
        functions.publish_acknowledged(revocation.TOPIC, json.dumps({"revoke": {"token_id": first.token_id}}))
        assert client.ended()
        assert not broker.accepts(space, broker.issue(first))
        assert broker.accepts(space, broker.issue(second))


# ---------------------------------------------------------------- control topic


def test_an_invalid_control_message_is_not_acknowledged(broker: RunningBroker) -> None:
    two_names = b'{"revoke":{"client_id":"a","principal":"b"}}'
    for message in (b"", b"{}", b"null", b'{"revoke":{}}', two_names, b'{"revoke":{"all":true}}'):
        with broker.service() as functions:
            sent = functions.publish(revocation.TOPIC, message)
            assert functions.ended(), message
            assert not functions.acknowledged(sent)


def test_control_messages_are_neither_delivered_nor_retained(broker: RunningBroker, space: str, topic: str) -> None:
    with (
        broker.client(space, publish=(topic,), subscribe=(topic, revocation.TOPIC, "$CONTROL/#")) as client,
        broker.service() as functions,
    ):
        client.subscribe(revocation.TOPIC, "$CONTROL/#", topic)
        functions.publish_acknowledged(revocation.TOPIC, json.dumps({"revoke": {"client_id": "unknown"}}), retain=True)
        client.subscribe(revocation.TOPIC)
        client.publish_acknowledged(topic, b"end")
        assert [message.topic for message in (client.receive(), *client.pending())] == [topic]


def test_a_will_cannot_use_the_control_topic(broker: RunningBroker) -> None:
    service = broker.access.service_credentials()
    will = Message(revocation.TOPIC, b'{"revoke":{"client_id":"x"}}', 1, retain=False)
    assert not broker.accepts(service.client_id, Credentials(service.username, service.password), will=will)


# ---------------------------------------------------------------- strict rejection


def test_mqtt_5_is_rejected_immediately_in_the_old_format(broker: RunningBroker, space: str) -> None:
    for credentials in (None, broker.issue(broker.grant(space))):
        with RawConnection(broker.tcp_port) as raw:
            raw.send(raw_mqtt.connect_packet(space, credentials, level=5))
            assert raw.read() == (raw_mqtt.CONNACK, 0, b"\0\1")
            assert raw.closed()


@pytest.mark.parametrize(
    ("payload", "options"),
    [
        (b"denied", {"qos": 0}),
        (b"denied", {"qos": 1}),
        (b"denied", {"qos": 0, "retain": True}),
        (b"denied", {"qos": 1, "retain": True}),
        (b"x", {"qos": 2}),
        (bytes(codec.MAX_BYTES + 1), {}),
        (bytes(codec.MAX_RETAINED_BYTES + 1), {"retain": True}),
    ],
    ids=lambda value: str(len(value)) if isinstance(value, bytes) else str(value),
)
def test_a_publish_beyond_the_contract_closes_the_connection(
    broker: RunningBroker, space: str, topic: str, payload: bytes, options: dict[str, int]
) -> None:
    with broker.client(space, publish=(topic,), subscribe=(topic,)) as client:
        assert client.subscribe(topic, qos=2) == [1]
        client.publish_acknowledged(topic, bytes(codec.MAX_BYTES))
        client.publish(f"{topic}/denied" if payload == b"denied" else topic, payload, **options)  # type: ignore[arg-type]
        assert client.ended()


@pytest.mark.parametrize("kind", ["ctl/7", "cmd", "stop/account", "ack", "event", "tele/joints"])
def test_a_retained_message_of_a_class_without_retention_is_rejected(
    broker: RunningBroker, space: str, kind: str
) -> None:
    topic = f"ts/v1/{space}/arm/ur5/{kind}"
    with broker.client(space, publish=(topic,), subscribe=(topic,)) as client:
        client.subscribe(topic)
        client.publish(topic, b"x", retain=True)
        assert client.ended()
        assert client.pending() == []
    credentials = broker.issue(broker.grant(space, publish=(topic,)))
    assert not broker.accepts(space, credentials, will=Message(topic, b"x", 1, retain=True))


def test_a_denied_filter_does_not_affect_others(broker: RunningBroker, space: str) -> None:
    mine = f"ts/v1/{space}/arm/+"
    rejected = ("#", "ts/v1/+/arm/conn", f"{mine}/#", "$SYS/#", "", "ts/v1/#/conn", f"ts/v1/{space}/arm/a+", "x" * 600)
    with raw_mqtt.open_session(broker, space, broker.issue(broker.grant(space, subscribe=(mine,)))) as raw:
        raw.send(raw_mqtt.subscribe_packet(*rejected[:4], mine, *rejected[4:]))
        assert raw.read() == (raw_mqtt.SUBACK, 0, b"\0\1" + b"\x80" * 4 + b"\0" + b"\x80" * 4)


def test_sessions_are_always_clean(broker: RunningBroker, space: str, topic: str) -> None:
    credentials = broker.issue(broker.grant(space, publish=(topic,), subscribe=(topic,)))
    for _ in range(2):
        with raw_mqtt.open_session(broker, space, credentials, clean=False) as raw:
            raw.send(raw_mqtt.publish_packet(topic, b"x", qos=1))
            assert raw.read() == (raw_mqtt.PUBACK, 0, b"\0\1"), "a subscription survived the session"
            raw.send(raw_mqtt.subscribe_packet(topic, qos=1))
            assert raw.read() == (raw_mqtt.SUBACK, 0, b"\0\1\1")


# ---------------------------------------------------------------- tokens and keys


def test_a_token_with_a_too_long_lifetime_is_rejected(broker: RunningBroker, space: str) -> None:
    hour_s = 3_600  # revocations of accounts and agents need not be stored longer; services are not revoked
    for principal, longest_s in (
        ("account:a", hour_s / 2),
        ("agent:a", 2 * hour_s),
        ("service:functions", 25 * hour_s),
    ):
        for lifetime_s, accepted in ((longest_s, True), (longest_s + 60, False)):
            grant = broker.grant(space, principal=principal, lifetime_s=lifetime_s)
            assert broker.accepts(space, broker.issue(grant)) is accepted


def test_the_log_names_rejected_clients_but_no_secrets(broker: RunningBroker, space: str) -> None:
    credentials = broker.issue(broker.grant(space))
    assert not broker.accepts(f"{space}-thief", credentials)
    line = f"CONNECT as '{space}-thief' refused: the token belongs to another client id"
    wait_until(lambda: line in broker.stderr(), "the refusal in the log")
    assert credentials.password not in broker.stderr()


def test_changed_keys_are_reloaded(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    old, new = signing.generate(), signing.generate()

    def write(*keys: object) -> None:
        public = [key.public_key() for key in keys]  # type: ignore[attr-defined]
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps({signing.key_id(key): signing.public_text(key) for key in public}))
        temporary.replace(path)

    write(old)
    with start_broker("amqtt", tmp_path / "home", keys=path) as broker:
        grant = broker.grant("agent", lifetime_s=600)
        by_old, by_new = (Credentials(grant.principal, grants.issue(grant, key)) for key in (old, new))
        assert not broker.accepts("agent", by_new)
        write(old, new)
        assert broker.accepts("agent", by_new)
        with broker.connect("agent", by_old) as client:
            assert client.connected.is_set()
            path.write_text("{ not json")
            assert not client.disconnected.wait(SILENCE_S), "invalid keys must not replace the current ones"
            write(new)
            assert client.ended()
        assert not broker.accepts("agent", by_old)
        assert "Traceback" not in broker.stderr()
