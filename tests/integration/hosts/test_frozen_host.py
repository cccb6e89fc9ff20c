"""A host that freezes the functions between two requests: their connection to the broker may be dead when they thaw."""

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
from tests.harness.hosts.reached import Reached
from tests.harness.network.brokers import PATIENCE_S, Client, RunningBroker, start_broker
from tests.harness.network.proxy import Proxy, start_proxy

TOPIC = "ts/v1/space/agent/arm/cmd"


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
    """A bus whose loop only turns during a call."""

    def __init__(self, broker: RunningBroker, proxy: Proxy) -> None:
        self.loop = asyncio.new_event_loop()
        self.bus = MqttCommandBus(
            connection.Broker(host="127.0.0.1", port=proxy.port, credentials=broker.access.service_credentials)
        )

    def publish(self, text: str, qos: int = 1) -> None:
        self.loop.run_until_complete(self.bus.publish(TOPIC, text.encode(), qos=qos))


@pytest.fixture
def frozen(broker: RunningBroker, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> Iterator[Frozen]:
    monkeypatch.setattr(connection, "FROST_S", 0.2)
    for place, name in ((connection, "READY_TIMEOUT_S"), (connection, "CONFIRM_TIMEOUT_S"), (command_bus, "_READY_S")):
        monkeypatch.setattr(place, name, PATIENCE_S)
    found = Frozen(broker, proxy)
    yield found
    found.loop.run_until_complete(found.bus.close())
    found.loop.run_until_complete(found.loop.shutdown_default_executor())
    found.loop.close()


@pytest.mark.parametrize("end", ["swallow", "cut"])
@pytest.mark.parametrize("qos", [1, 0])
def test_a_message_reaches_the_device_though_the_connection_died_in_the_frost(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch, *, end: str, qos: int
) -> None:
    frozen.publish("before")
    assert robot.receive().payload == b"before"
    known = proxy.accepted
    getattr(proxy, end)()
    time.sleep(0.3)
    frozen.publish("after", qos)
    assert robot.receive().payload == b"after"
    monkeypatch.setattr(connection, "FROST_S", PATIENCE_S)
    frozen.publish("and again")
    assert robot.receive().payload == b"and again"
    assert proxy.accepted == known + 1


def test_a_connection_that_lived_through_the_frost_is_used_on(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "PROOF_TIMEOUT_S", PATIENCE_S)
    frozen.publish("0")
    known = proxy.accepted
    for number in (1, 2):
        time.sleep(0.3)
        frozen.publish(str(number))
    assert [robot.receive().payload for _ in range(3)] == [b"0", b"1", b"2"]
    assert robot.pending() == []
    assert proxy.accepted == known


def test_what_the_broker_must_have_given_up_is_not_tried_first(
    frozen: Frozen, proxy: Proxy, robot: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "DEAD_S", 0.25)
    monkeypatch.setattr(connection, "PROOF_TIMEOUT_S", PATIENCE_S)
    frozen.publish("before")
    known = proxy.accepted
    proxy.swallow()
    time.sleep(0.3)
    frozen.publish("after")
    assert [robot.receive().payload for _ in range(2)] == [b"before", b"after"]
    assert proxy.accepted > known


def test_health_tells_of_a_connection_that_works(frozen: Frozen, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    assert frozen.loop.run_until_complete(frozen.bus.status()) == "ok"
    monkeypatch.setattr(connection, "DEAD_S", 0.25)
    proxy.swallow()
    time.sleep(0.3)
    assert "given up" in frozen.loop.run_until_complete(frozen.bus.status())
    frozen.loop.run_until_complete(frozen.bus.start())
    monkeypatch.setattr(connection, "DEAD_S", PATIENCE_S)
    assert frozen.loop.run_until_complete(frozen.bus.status()) == "ok"


def test_an_instance_that_thaws_reaches_the_robot_and_hears_it(tmp_path: Path) -> None:
    keys = tmp_path / "home" / "keys"
    FileKeys(keys).load()
    with (
        start_broker("amqtt", tmp_path / "broker", keys=keys / "public.json") as broker,
        start_proxy(broker.tcp_port) as proxy,
    ):
        environment = {"TELESCOPE_HOME": str(keys.parent), "TELESCOPE_MQTT_PORT": str(proxy.port)}
        with start_lambda(environment) as host:
            there = Reached(host, environment)
            with there.sign_in("anna") as anna, there.robot() as robot:
                there.pair(anna, robot)
                for _ in range(3):
                    robot.connect()
                    presence = Presence(online=True, session=robot.session, at_ms=there.clock.now_ms())
                    host.deliver(topics.conn(robot.space, robot.id), codec.encode(presence))
                    asked = {"request": MOVE, "wait_ms": 10_000}
                    action = anna.post(f"/devices/{robot.device}/actions", json=asked).json()
                    assert action["status"] == "started", action
                    done = robot.report(action["id"], AckStatus.DONE)
                    host.deliver(robot.topic(topics.ACK), codec.encode(done))
                    assert anna.get(f"/actions/{action['id']}").json()["status"] == "done"
                    assert robot.link is not None
                    robot.link.close()
                    proxy.cut()
            assert len(host.instances) == 1
