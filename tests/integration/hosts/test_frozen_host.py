"""A host that freezes the functions between requests: afterwards their connection to the broker may be dead."""

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol import AckStatus, Presence, codec, topics
from function_app.adapters.local import command_bus
from function_app.adapters.local.command_bus import MqttCommandBus
from function_app.adapters.local.signing_keys import FileKeys
from function_app.adapters.mqtt import connection
from tests.harness.cloud.cloud import MOVE
from tests.harness.hosts.aws import start_lambda
from tests.harness.hosts.host_client import HostClient
from tests.harness.network.brokers import PATIENCE_S, Client, RunningBroker, start_broker
from tests.harness.network.proxy import Proxy, start_proxy

TOPIC = "ts/v1/space/agent/arm/cmd"
FREEZE_S = 0.3


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningBroker]:
    with start_broker("amqtt", tmp_path_factory.mktemp("broker")) as running:
        yield running


@pytest.fixture
def proxy(broker: RunningBroker) -> Iterator[Proxy]:
    with start_proxy(broker.tcp_port) as running:
        yield running


@pytest.fixture
def robot(broker: RunningBroker) -> Iterator[Client]:
    with broker.client("arm", subscribe=(TOPIC,)) as client:
        assert client.subscribe(TOPIC) == [1]
        yield client


class Frozen:
    """A bus whose event loop only runs during a call."""

    def __init__(self, broker: RunningBroker, proxy: Proxy) -> None:
        self.loop = asyncio.new_event_loop()
        at = connection.Broker(host="127.0.0.1", port=proxy.port, credentials=broker.access.service_credentials)
        self.bus = MqttCommandBus(at)

    def publish(self, text: str, qos: int = 1) -> None:
        self.loop.run_until_complete(self.bus.publish(TOPIC, text.encode(), qos=qos))

    def status(self) -> str:
        return self.loop.run_until_complete(self.bus.status())


@pytest.fixture
def frozen(broker: RunningBroker, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> Iterator[Frozen]:
    monkeypatch.setattr(connection, "FREEZE_S", FREEZE_S - 0.1)
    for module, name in ((connection, "READY_TIMEOUT_S"), (connection, "CONFIRM_TIMEOUT_S"), (command_bus, "_READY_S")):
        monkeypatch.setattr(module, name, PATIENCE_S)
    frozen = Frozen(broker, proxy)
    yield frozen
    frozen.loop.run_until_complete(frozen.bus.close())
    frozen.loop.run_until_complete(frozen.loop.shutdown_default_executor())
    frozen.loop.close()


@pytest.mark.parametrize("end", ["swallow", "cut"])
@pytest.mark.parametrize("qos", [1, 0])
def test_a_message_arrives_although_the_connection_died_while_frozen(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch, *, end: str, qos: int
) -> None:
    frozen.publish("before")
    accepted = proxy.accepted
    getattr(proxy, end)()
    time.sleep(FREEZE_S)
    frozen.publish("after", qos)
    monkeypatch.setattr(connection, "FREEZE_S", PATIENCE_S)
    frozen.publish("again")
    assert robot.payloads(3) == [b"before", b"after", b"again"]
    assert proxy.accepted == accepted + 1


def test_a_connection_that_survived_is_reused(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "VERIFY_TIMEOUT_S", PATIENCE_S)
    frozen.publish("0")
    accepted = proxy.accepted
    for number in (1, 2):
        time.sleep(FREEZE_S)
        frozen.publish(str(number))
    assert robot.payloads(3) == [b"0", b"1", b"2"]
    assert robot.pending() == []
    assert proxy.accepted == accepted


def test_a_connection_that_the_broker_must_have_closed_is_not_used_first(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "SESSION_TIMEOUT_S", FREEZE_S - 0.05)
    monkeypatch.setattr(connection, "VERIFY_TIMEOUT_S", PATIENCE_S)
    frozen.publish("before")
    accepted = proxy.accepted
    proxy.swallow()
    time.sleep(FREEZE_S)
    frozen.publish("after")
    assert robot.payloads(2) == [b"before", b"after"]
    assert proxy.accepted > accepted


def test_the_status_is_of_a_working_connection(frozen: Frozen, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    assert frozen.status() == "ok"
    monkeypatch.setattr(connection, "SESSION_TIMEOUT_S", FREEZE_S - 0.05)
    proxy.swallow()
    time.sleep(FREEZE_S)
    assert "connection was replaced" in frozen.status()
    frozen.loop.run_until_complete(frozen.bus.start())
    monkeypatch.setattr(connection, "SESSION_TIMEOUT_S", PATIENCE_S)
    assert frozen.status() == "ok"


def test_a_lambda_instance_exchanges_messages_with_a_robot_after_each_freeze(tmp_path: Path) -> None:
    keys = tmp_path / "home" / "keys"
    FileKeys(keys).load()
    with (
        start_broker("amqtt", tmp_path / "broker", keys=keys / "public.json") as broker,
        start_proxy(broker.tcp_port) as proxy,
    ):
        environment = {"TELESCOPE_HOME": str(keys.parent), "TELESCOPE_MQTT_PORT": str(proxy.port)}
        with start_lambda(environment) as host:
            client = HostClient(host, environment)
            with client.sign_in("anna") as anna, client.robot() as robot:
                client.pair(anna, robot)
                for _ in range(3):
                    robot.connect()
                    presence = Presence(online=True, session=robot.session, at_ms=client.clock.now_ms())
                    host.deliver(topics.conn(robot.space, robot.id), codec.encode(presence))
                    body = {"request": MOVE, "wait_ms": 10_000}
                    action = anna.post(f"/devices/{robot.device}/actions", json=body).json()
                    assert action["status"] == "started", action
                    done = robot.report(action["id"], AckStatus.DONE)
                    host.deliver(robot.topic(topics.ACK), codec.encode(done))
                    assert anna.get(f"/actions/{action['id']}").json()["status"] == "done"
                    assert robot.link is not None
                    robot.link.close()
                    proxy.cut()
            assert len(host.instances) == 1
