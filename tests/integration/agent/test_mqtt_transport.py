"""The agent's MQTT transport over real brokers: its link, its presence, its will, its way back."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from device_agent.protocol import codec, grants, topics
from device_agent.protocol.messages import Presence
from device_agent.transports.mqtt import BrokerAccess, MqttTransport
from tests.support.brokers import BROKERS, HOST, ROOT, Client, RunningBroker, start_broker, wait_until

CONN = topics.conn("lab", "arm1")
CMD = topics.device("lab", "arm1", "arm", topics.CMD)
ACK = topics.device("lab", "arm1", "arm", topics.ACK)


@pytest.fixture(params=BROKERS)
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RunningBroker]:
    with start_broker(request.param, tmp_path / "broker") as broker:
        yield broker
        for link in Link.started:
            link.transport.stop()
        Link.started.clear()


class Link:
    """A started transport and what it told. The fixture ends it."""

    started: ClassVar[list["Link"]] = []

    def __init__(
        self, broker: RunningBroker, *, port: int = 0, lifetime_s: float = 300, quiet: Callable[[], bool] = lambda: True
    ):
        self.received: list[tuple[str, bytes]] = []
        self.changes: list[bool] = []
        self.sessions = 0
        self.asked = 0
        self.broker = broker
        self.port = port or broker.tcp_port
        self.lifetime_s = lifetime_s
        self.transport = MqttTransport(
            access=self.access, presence_topic=CONN, next_session=self.next_session, software="test", quiet=quiet
        )
        self.started.append(self)
        self.transport.start(lambda topic, payload: self.received.append((topic, payload)), self.changes.append)

    def access(self) -> BrokerAccess:
        self.asked += 1
        grant = grants.agent_grant("lab", "arm1", token_id=os.urandom(8).hex(), lifetime_s=self.lifetime_s)
        credentials = self.broker.issue(grant)
        return BrokerAccess(
            host=HOST,
            port=self.port,
            client_id=grant.client_id,
            username=credentials.username,
            password=credentials.password,
            subscribe=grant.subscribe,
            lifetime_s=self.lifetime_s,
        )

    def next_session(self) -> int:
        self.sessions += 1
        return self.sessions

    def up(self, times: int = 1) -> None:
        wait_until(lambda: self.changes.count(True) >= times, f"link number {times}")


def watcher(broker: RunningBroker) -> Client:
    client = broker.service()
    client.subscribe(CONN, ACK)
    return client


def presences(client: Client) -> list[Presence]:
    return [codec.decode(message.payload, Presence) for message in client.heard() if message.topic == CONN]


def test_it_is_up_only_when_it_can_hear_and_says_so_retained(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    with watcher(broker) as late:
        message = late.receive()
        assert message.retain
        assert codec.decode(message.payload, Presence).online
        late.publish(CMD, b"order")
        wait_until(lambda: link.received == [(CMD, b"order")], "the command")
    link.transport.stop()


def test_a_message_is_reported_delivered(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    delivered: list[bool] = []
    with watcher(broker) as other:
        assert link.transport.publish(ACK, b"{}", qos=1, delivered=lambda: delivered.append(True))
        wait_until(lambda: delivered, "the confirmation")
        wait_until(lambda: any(message.topic == ACK for message in other.heard()), "the ack")
    link.transport.stop()
    assert not link.transport.publish(ACK, b"{}", qos=1)


def test_whoever_hears_of_a_delivery_may_publish_while_others_do(broker: RunningBroker) -> None:
    """The client library holds a lock of its own while it confirms: a lock of ours around publishing would deadlock."""
    link = Link(broker)
    link.up()
    delivered: list[str] = []

    def publish(name: str, then: Callable[[], None] = lambda: None) -> None:
        def note() -> None:
            then()
            delivered.append(name)

        assert link.transport.publish(ACK, b"{}", qos=1, delivered=note)

    def while_another_publishes() -> None:
        threading.Thread(target=publish, args=("another",), daemon=True).start()
        time.sleep(0.1)
        publish("second")

    publish("first", while_another_publishes)
    wait_until(lambda: sorted(delivered) == ["another", "first", "second"], "all confirmations")
    assert link.changes == [True]


def test_a_clean_end_says_offline_in_the_same_session(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    with watcher(broker) as other:
        assert codec.decode(other.receive().payload, Presence).online
        link.transport.stop()
        last = codec.decode(other.receive().payload, Presence)
        assert (last.online, last.session) == (False, link.sessions)
    assert link.changes == [True, False]


def test_a_killed_agent_is_declared_offline_by_its_will(broker: RunningBroker) -> None:
    grant = grants.agent_grant("lab", "arm1", token_id=os.urandom(8).hex(), lifetime_s=300)
    credentials = broker.issue(grant)
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(broker.tcp_port), *credentials, *grant.subscribe],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    with child:
        assert child.stdout is not None
        assert child.stdout.readline() == "up\n"
        with watcher(broker) as other:
            assert codec.decode(other.receive().payload, Presence).online
            child.send_signal(signal.SIGKILL)
            last = codec.decode(other.receive().payload, Presence)
            assert (last.online, last.session) == (False, 7)


_CHILD = f"""
import sys, time
from device_agent.transports.mqtt import BrokerAccess, MqttTransport
port, username, password, *subscribe = sys.argv[1:]
access = BrokerAccess(host="{HOST}", port=int(port), client_id="arm1", username=username, password=password,
                      subscribe=tuple(subscribe), lifetime_s=300)
transport = MqttTransport(access=lambda: access, presence_topic="{CONN}", next_session=lambda: 7, software="")
transport.start(lambda *_: None, lambda up: print("up", flush=True))
time.sleep(60)
"""


def test_it_comes_back_after_the_broker_was_killed(broker: RunningBroker, tmp_path: Path) -> None:
    link = Link(broker)
    link.up()
    broker.kill()
    wait_until(lambda: link.changes[-1] is False, "the loss")
    assert not link.transport.publish(ACK, b"{}", qos=1)
    with start_broker(broker.kind, tmp_path / "broker", tcp_port=broker.tcp_port) as again:
        link.broker = again
        link.up(2)
        with watcher(again) as other:
            presence = codec.decode(other.receive().payload, Presence)
            assert presence.online
            assert presence.session == link.sessions > 1
        link.transport.stop()
        Link.started.clear()


def test_it_renews_its_credentials_before_they_end_but_not_while_something_moves(broker: RunningBroker) -> None:
    moving = [True]
    link = Link(broker, lifetime_s=5, quiet=lambda: not moving[0])
    link.up()
    asked = link.asked
    time.sleep(4.3)
    assert link.asked == asked
    moving[0] = False
    link.up(2)
    assert link.asked == asked + 1
    link.transport.stop()


def test_an_order_that_a_broker_kept_is_not_obeyed(broker: RunningBroker) -> None:
    with broker.service() as functions:
        functions.publish_acknowledged(CMD, b"old", retain=True)
        link = Link(broker)
        link.up()
        functions.publish(CMD, b"new")
        wait_until(lambda: (CMD, b"new") in link.received, "the new order")
        assert link.received == [(CMD, b"new")]
        link.transport.stop()


def test_small_messages_never_wait_for_nagle(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    client: Any = link.transport._client
    assert client.socket().getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
    link.transport.stop()


def test_without_a_broker_it_keeps_trying_and_ends_when_told(broker: RunningBroker) -> None:
    link = Link(broker, port=1)
    wait_until(lambda: link.asked >= 3, "three attempts")
    assert link.changes == []
    link.transport.stop()
    asked = link.asked
    time.sleep(0.5)
    assert link.asked == asked
