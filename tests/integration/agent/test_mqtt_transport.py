"""The MQTT transport over real brokers; ``tests/contract/transports`` has the contract of all transports."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import Presence, codec, topics
from device_agent.protocol.security import grants
from device_agent.transports.mqtt import BrokerAccess, MqttTransport
from tests.harness.network.brokers import BROKERS, HOST, RunningBroker, start_broker, wait_until
from tests.harness.network.proxy import Proxy, start_proxy
from tests.harness.paths import ROOT

CONN = topics.conn("lab", "arm1")
ACK = topics.device("lab", "arm1", "arm", topics.ACK)
MODULE = "device_agent.transports.mqtt.transport"


@pytest.fixture(params=BROKERS)
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RunningBroker]:
    with start_broker(request.param, tmp_path / "broker") as broker:
        yield broker


@pytest.fixture
def proxy(broker: RunningBroker) -> Iterator[Proxy]:
    with start_proxy(broker.tcp_port) as proxy:
        yield proxy


class Link:
    """A transport, the messages that it has received, and the changes of its link."""

    def __init__(self, broker: RunningBroker) -> None:
        self.received: list[tuple[str, bytes]] = []
        self.changes: list[bool] = []
        self.sessions = self.requests = self.failed_requests = 0
        self.quiet = False
        self.cloud_reachable = True
        self.lifetime_s = 300
        self.port = broker.tcp_port
        self._broker = broker
        self.transport = MqttTransport(
            access=self._access,
            presence_topic=CONN,
            next_session=self._next_session,
            software="test",
            quiet=lambda: self.quiet,
        )

    def start(self) -> "Link":
        self.transport.start(lambda *message: self.received.append(message), self.changes.append)
        return self.up()

    def up(self, times: int = 1) -> "Link":
        wait_until(lambda: self.changes.count(True) >= times, f"link number {times}")
        return self

    def publish(self, payload: bytes, **options: Any) -> bool:
        return self.transport.publish(ACK, payload, **{"qos": 1, **options})

    def _access(self) -> BrokerAccess:
        if not self.cloud_reachable:
            self.failed_requests += 1
            raise OSError("the cloud cannot be reached")
        self.requests += 1
        grant = grants.agent_grant("lab", "arm1", token_id=os.urandom(8).hex(), lifetime_s=self.lifetime_s)
        credentials = self._broker.issue(grant)
        return BrokerAccess(
            host=HOST,
            port=self.port,
            client_id=grant.client_id,
            username=credentials.username,
            password=credentials.password,
            subscribe=grant.subscribe,
            lifetime_s=self.lifetime_s,
        )

    def _next_session(self) -> int:
        self.sessions += 1
        return self.sessions


@pytest.fixture
def link(broker: RunningBroker) -> Iterator[Link]:
    """A transport before its start."""
    link = Link(broker)
    yield link
    link.transport.stop()


@pytest.fixture
def fragile(link: Link, proxy: Proxy) -> Link:
    """A started transport whose connection goes through the proxy."""
    link.port = proxy.port
    return link.start()


def test_a_killed_agent_is_declared_offline_by_its_will(broker: RunningBroker) -> None:
    grant = grants.agent_grant("lab", "arm1", token_id=os.urandom(8).hex(), lifetime_s=300)
    credentials = broker.issue(grant)
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(broker.tcp_port), *credentials, *grant.subscribe],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    with child, broker.service() as observer:
        assert child.stdout is not None
        assert child.stdout.readline() == "up\n"
        observer.subscribe(CONN)
        assert codec.decode(observer.receive().payload, Presence).online
        child.send_signal(signal.SIGKILL)
        last = codec.decode(observer.receive().payload, Presence)
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


def test_credentials_are_renewed_before_they_expire_but_not_during_motion(
    link: Link, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Motion starts immediately, so that a slow machine does not reach the share at which renewal no longer waits.
    monkeypatch.setattr(f"{MODULE}._REFRESH_AT", 1 / 120)
    link.lifetime_s = 120
    link.start()
    requests = link.requests
    time.sleep(2)
    assert link.requests == requests
    link.transport._quiet = lambda: link.requests == requests
    link.up(2)
    assert link.requests == requests + 1
    assert link.changes == [True, True], "a short interruption is not reported as a lost link"
    link.transport.stop()
    assert link.changes == [True, True, False]


@pytest.fixture
def renewal_when_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{MODULE}._REFRESH_AT", 0.0)


@pytest.mark.usefixtures("renewal_when_quiet")
def test_a_long_renewal_is_a_lost_link_until_it_ends(fragile: Link, proxy: Proxy) -> None:
    proxy.refuse()
    fragile.quiet = True
    wait_until(lambda: fragile.changes == [True, False], "the loss")
    fragile.quiet = False
    proxy.admit()
    fragile.up(2)
    assert fragile.changes == [True, False, True]


@pytest.mark.usefixtures("renewal_when_quiet")
def test_a_renewal_with_unacknowledged_messages_is_a_lost_link(fragile: Link, proxy: Proxy) -> None:
    proxy.freeze()
    acknowledged: list[bool] = []
    assert fragile.publish(b"{}", delivered=lambda: acknowledged.append(True))
    fragile.quiet = True
    wait_until(lambda: fragile.changes == [True, False], "the loss")
    assert not acknowledged
    fragile.quiet = False
    proxy.thaw()
    fragile.up(2)


@pytest.mark.usefixtures("renewal_when_quiet")
def test_without_new_credentials_the_old_ones_stay_in_use(link: Link, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{MODULE}._RENEWAL_RETRY_S", 0.1)
    link.start()
    link.cloud_reachable = False
    link.quiet = True
    wait_until(lambda: link.failed_requests >= 3, "attempts")
    assert link.changes == [True]
    assert link.publish(b"{}", qos=0)
    link.cloud_reachable = True
    link.up(2)
    link.quiet = False
    assert False not in link.changes


def test_a_connection_that_waits_for_acknowledgements_accepts_no_messages(link: Link) -> None:
    connection: Any = link.start().transport._connection
    assert link.publish(b"{}")
    connection.settle(0.0)
    assert not link.publish(b"{}", delivered=lambda: None)
    assert not connection._delivered


def test_an_agent_too_busy_to_receive_does_not_treat_the_broker_as_silent(
    broker: RunningBroker, link: Link, monkeypatch: pytest.MonkeyPatch
) -> None:
    class SlowList(list[Any]):
        def append(self, message: Any) -> None:
            super().append(message)
            time.sleep(4)

    monkeypatch.setattr(f"{MODULE}.KEEP_ALIVE_S", 2)
    monkeypatch.setattr(f"{MODULE}.SILENCE_TIMEOUT_S", 3.0)
    link.received = SlowList()
    link.start()
    with broker.service() as cloud:
        cloud.publish(topics.device("lab", "arm1", "arm", topics.CMD), b"{}")
        wait_until(lambda: link.received, "the command")
        end_s = time.monotonic() + 5
        while time.monotonic() < end_s:
            assert link.publish(b"{}", qos=0), "published messages must keep the connection alive"
            time.sleep(0.1)
    assert link.changes == [True]


def test_connections_have_tcp_nodelay(link: Link) -> None:
    connection: Any = link.start().transport._connection
    assert connection._client.socket().getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


def test_on_a_blocked_link_one_frame_of_each_camera_waits(fragile: Link, proxy: Proxy) -> None:
    def publish(camera: str, size: int) -> bool:
        topic = topics.device("lab", "arm1", "eye", topics.CAM, camera)
        return fragile.transport.publish(topic, bytes(size), qos=0)

    for _ in range(2):
        wait_until(lambda: publish("left", 1000), "a frame to be accepted")
    proxy.freeze()
    accepted = 0
    for _ in range(400):  # 40 MB: more than the sockets hold
        accepted += publish("left", 100_000)
        time.sleep(0.001)
    assert accepted < 350
    assert not any(publish("left", 100_000) for _ in range(20)), "another frame is queued"
    assert publish("right", 1000), "frames of another camera are independent"
    proxy.thaw()
    wait_until(lambda: publish("left", 1000), "frames to be accepted again")
