"""Clients that connect and never finish a request do not keep operators and agents out.

The attackers share the operator's address and use further addresses. Server and broker have few file descriptors.
"""

import http.client
import itertools
import json
import logging
import math
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from device_agent.protocol import Stop, codec, topics
from function_app.ports.broker_access import Credentials
from tests.harness.cloud.cloud import API
from tests.harness.cloud.cloud_processes import CloudProcesses, Link, start_cloud_processes
from tests.harness.network.brokers import BROKERS, HOST, PATIENCE_S, BrokerKind, Client, wait_until
from tests.harness.network.half_open import start_half_open_clients

LISTENING = "0A"
"""State in /proc/net/tcp."""


class Size(NamedTuple):
    """Size of an attack, and when Stops are sent during it."""

    connections: int
    descriptors: int
    stops: int
    every_s: float = 0.0
    limit_s: float = math.inf
    reconnection_limit_s: float = math.inf


SMALL = Size(connections=400, descriptors=384, stops=20)
FULL = Size(connections=5_000, descriptors=1_024, stops=200, every_s=0.05, limit_s=0.25, reconnection_limit_s=10.0)
"""``limit_s`` is the acceptance criterion for 99 % of the Stops, ``reconnection_limit_s`` that of the agent.

The full size runs alone."""


class Operator:
    """Anna with one MQTT connection; measures the time until the agent receives her Stop."""

    def __init__(self, processes: CloudProcesses, link: Link) -> None:
        self._link = link
        self._processes = processes
        self._numbers = itertools.count()
        self._connections: list[http.client.HTTPConnection] = []
        self._device = link.robot.device
        issued = processes.anna.post("/mqtt/credentials", {"purpose": "view"}).json()
        self._stop_topic = next(topic for topic in issued["publish"] if topics.parse(topic).agent == link.robot.id)
        credentials = Credentials(issued["username"], issued["password"])
        self.mqtt: Client = processes.broker.running.connect(issued["client_id"], credentials)
        assert self.mqtt.connected.is_set()

    def stop_over_mqtt(self) -> float:
        """Time of one Stop over the existing connection [s]."""
        number = f"mqtt-{next(self._numbers)}"
        payload = codec.encode(Stop(id=number, reason=number))
        return self._measured(number, lambda: self.mqtt.publish(self._stop_topic, payload))

    def stop_over_http(self) -> float:
        """Time of one Stop over a new connection [s]."""
        number = f"http-{next(self._numbers)}"
        connection = http.client.HTTPConnection(HOST, int(self._processes.url.rsplit(":")[-1]), timeout=PATIENCE_S)
        headers = {"Authorization": f"Bearer {self._processes.anna.token}", "Content-Type": "application/json"}
        body = json.dumps({"reason": number})
        url = f"{API}/devices/{self._device}/stop"
        self._connections.append(connection)  # the response waits for the confirmation of the device
        return self._measured(number, lambda: connection.request("POST", url, body, headers))

    def read_responses(self) -> list[int]:
        """Status of the response to each Stop over HTTP."""
        statuses = [connection.getresponse().status for connection in self._connections]
        for connection in self._connections:
            connection.close()
        return statuses

    def _measured(self, reason: str, send: Callable[[], object]) -> float:
        start_s = time.monotonic()
        send()
        wait_until(lambda: self._arrived(reason), reason)
        return time.monotonic() - start_s

    def _arrived(self, reason: str) -> bool:
        return any(
            topics.parse(topic).kind == topics.STOP and codec.decode(payload, Stop).reason == reason
            for topic, payload in self._link.received[-20:]
        )


def server_sockets(*ports: int) -> int:
    """Number of sockets of accepted connections at these local ports that a process holds."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    local = {f"{port:04X}" for port in ports}
    return sum(row[1].rpartition(":")[2] in local and row[3] != LISTENING and row[9] != "0" for row in rows)


@pytest.mark.sampled
@pytest.mark.parametrize(
    ("kind", "size"),
    [*((kind, SMALL) for kind in BROKERS), *(pytest.param(kind, FULL, marks=pytest.mark.long) for kind in BROKERS)],
    ids=["amqtt-small", "mosquitto-small", "amqtt-full", "mosquitto-full"],
)
def test_half_open_connections_do_not_delay_stop_and_leave_no_socket(
    kind: BrokerKind, size: Size, tmp_path: Path
) -> None:
    launcher = ("tests.harness.network.few_descriptors", str(size.descriptors))
    with (
        start_cloud_processes(kind, tmp_path, launcher=launcher) as processes,
        Link(processes, {"transport": "mqtt"}) as link,
    ):
        link.start().up()
        operator = Operator(processes, link)
        broker, api = processes.broker.running, processes.endpoints["server"].port
        ports = (api, broker.tcp_port, broker.websocket_port)
        before = server_sockets(*ports)
        half = size.connections // 2
        targets = ((api, "http", size.connections), (broker.tcp_port, "tcp", half))
        with start_half_open_clients(*targets, (broker.websocket_port, "websockets", half)) as attackers:
            attackers.await_open()
            taken_s: dict[str, list[float]] = {"HTTP": [], "MQTT": []}
            for _ in range(size.stops):
                taken_s["HTTP"].append(operator.stop_over_http())
                taken_s["MQTT"].append(operator.stop_over_mqtt())
                time.sleep(size.every_s)
            link.transport._connection._client.socket().shutdown(socket.SHUT_RDWR)  # type: ignore[attr-defined]
            link.up(times=2)
            reconnected_s = link.changed_s[-1] - link.changed_s[-2]
            assert set(operator.read_responses()) == {202}  # the fake agent does not confirm a Stop
            attackers.close()
        wait_until(lambda: server_sockets(*ports) <= before, "the sockets of the other connections to close")
    figures = {name: f"p50 {_share(each, 0.5):.3f} s, p99 {_share(each, 0.99):.3f} s" for name, each in taken_s.items()}
    figures["reconnection"] = f"{reconnected_s:.3f} s"
    logging.getLogger(__name__).info("Stop and reconnection during the attack, %s: %s", kind, figures)
    assert max(_share(each, 0.99) for each in taken_s.values()) <= size.limit_s, figures
    assert reconnected_s <= size.reconnection_limit_s


def _share(times_s: list[float], share: float) -> float:
    """The time that this share of the Stops does not exceed [s]."""
    return sorted(times_s)[math.ceil(share * len(times_s)) - 1]
