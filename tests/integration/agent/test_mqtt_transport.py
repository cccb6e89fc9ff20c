"""What is the MQTT transport's own, over real brokers. What all promise is in ``tests/contract/transports``."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from device_agent.protocol import Presence, codec, topics
from device_agent.protocol.security import grants
from device_agent.transports.mqtt import BrokerAccess, MqttTransport
from tests.harness.network.brokers import BROKERS, HOST, Client, RunningBroker, start_broker, wait_until
from tests.harness.network.proxy import start_proxy
from tests.harness.paths import ROOT

CONN = topics.conn("lab", "arm1")
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
        self.refused = 0
        self.cloud_away = False
        self.broker = broker
        self.port = port or broker.tcp_port
        self.lifetime_s = lifetime_s
        self.transport = MqttTransport(
            access=self.access, presence_topic=CONN, next_session=self.next_session, software="test", quiet=quiet
        )
        self.started.append(self)
        self.transport.start(lambda topic, payload: self.received.append((topic, payload)), self.changes.append)

    def access(self) -> BrokerAccess:
        if self.cloud_away:
            self.refused += 1
            raise OSError("the cloud is away")
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


def test_it_renews_its_credentials_before_they_end_but_not_while_something_moves(
    broker: RunningBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    # From its first second on, so that a slow machine comes nowhere near the share at which it no longer waits.
    monkeypatch.setattr("device_agent.transports.mqtt.transport._REFRESH_AT", 1 / 120)
    still_for: list[int] = []
    link = Link(broker, lifetime_s=120, quiet=lambda: link.asked in still_for)
    link.up()
    asked = link.asked
    time.sleep(2)
    assert link.asked == asked
    still_for.append(asked)
    link.up(2)
    assert link.asked == asked + 1
    assert link.changes == [True, True], "so short a break is no loss of the link"
    link.transport.stop()
    assert link.changes == [True, True, False]


@pytest.fixture
def renewing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Credentials are renewed as soon as it is quiet."""
    monkeypatch.setattr("device_agent.transports.mqtt.transport._REFRESH_AT", 0.0)


@pytest.mark.usefixtures("renewing")
def test_a_renewal_that_takes_longer_is_a_loss_until_it_has_come_to_its_end(broker: RunningBroker) -> None:
    with start_proxy(broker.tcp_port) as proxy:
        still: list[bool] = []
        link = Link(broker, port=proxy.port, quiet=lambda: bool(still))
        link.up()
        proxy.refuse()
        still.append(True)
        wait_until(lambda: link.changes == [True, False], "the loss")
        still.clear()
        proxy.admit()
        link.up(2)
        assert link.changes == [True, False, True]


@pytest.mark.usefixtures("renewing")
def test_where_something_is_not_confirmed_a_renewal_is_a_loss(broker: RunningBroker) -> None:
    with start_proxy(broker.tcp_port) as proxy:
        still: list[bool] = []
        link = Link(broker, port=proxy.port, quiet=lambda: bool(still))
        link.up()
        proxy.freeze()
        confirmed: list[bool] = []
        assert link.transport.publish(ACK, b"{}", qos=1, delivered=lambda: confirmed.append(True))
        still.append(True)
        wait_until(lambda: link.changes == [True, False], "the loss")
        assert not confirmed
        still.clear()
        proxy.thaw()
        link.up(2)


def test_nothing_more_is_told_by_a_connection_that_waits_for_what_was(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    connection: Any = link.transport._connection
    assert link.transport.publish(ACK, b"{}", qos=1)
    connection.settle(0.0)
    assert not link.transport.publish(ACK, b"{}", qos=1, delivered=lambda: None)
    assert not connection._delivered


@pytest.mark.usefixtures("renewing")
def test_without_new_credentials_the_old_ones_serve_on(broker: RunningBroker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("device_agent.transports.mqtt.transport._RENEWAL_RETRY_S", 0.1)
    still: list[bool] = []
    link = Link(broker, quiet=lambda: bool(still))
    link.up()
    link.cloud_away = True
    still.append(True)
    wait_until(lambda: link.refused >= 3, "tries")
    assert link.changes == [True]
    assert link.transport.publish(ACK, b"{}", qos=0)
    link.cloud_away = False
    link.up(2)
    still.clear()
    assert False not in link.changes


def test_who_was_too_busy_to_listen_does_not_take_the_broker_for_silent(
    broker: RunningBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("device_agent.transports.mqtt.transport.KEEP_ALIVE_S", 2)
    monkeypatch.setattr("device_agent.transports.mqtt.transport.SILENCE_TIMEOUT_S", 3.0)
    link = Link(broker)
    link.received = Tedious()
    link.up()
    with broker.service() as cloud:
        cloud.publish(topics.device("lab", "arm1", "arm", topics.CMD), b"{}")
        wait_until(lambda: link.received, "the order")
        until_s = time.monotonic() + 5
        while time.monotonic() < until_s:
            assert link.transport.publish(ACK, b"{}", qos=0), "what it says keeps the connection alive"
            time.sleep(0.1)
    assert link.changes == [True]


class Tedious(list[tuple[str, bytes]]):
    """Takes four seconds for a message."""

    def append(self, message: tuple[str, bytes]) -> None:
        super().append(message)
        time.sleep(4)


def test_small_messages_never_wait_for_nagle(broker: RunningBroker) -> None:
    link = Link(broker)
    link.up()
    connection: Any = link.transport._connection
    assert connection._client.socket().getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0
    link.transport.stop()


def test_on_a_link_that_takes_nothing_one_picture_waits_and_no_queue_of_them(broker: RunningBroker) -> None:
    picture, other = (topics.device("lab", "arm1", "eye", topics.CAM, name) for name in ("left", "right"))
    with start_proxy(broker.tcp_port) as proxy:
        link = Link(broker, port=proxy.port)
        link.up()
        wait_until(lambda: link.transport.publish(picture, bytes(1000), qos=0), "a first picture to be taken")
        wait_until(lambda: link.transport.publish(picture, bytes(1000), qos=0), "a second one")
        proxy.freeze()
        taken = 0
        for _ in range(400):  # 40 MB: more than the sockets hold
            taken += link.transport.publish(picture, bytes(100_000), qos=0)
            time.sleep(0.001)
        assert taken < 350
        before = taken
        for _ in range(20):
            taken += link.transport.publish(picture, bytes(100_000), qos=0)
        assert taken == before, "a picture waits already"
        assert link.transport.publish(other, bytes(1000), qos=0), "another camera is another matter"
        proxy.thaw()
        wait_until(lambda: link.transport.publish(picture, bytes(1000), qos=0), "pictures to go on")
