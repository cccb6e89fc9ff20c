"""No connection delays a small message by the 40 ms of a delayed acknowledgement, as without TCP_NODELAY.

A proxy in front of each server delays TCP acknowledgements as a kernel may. The tests send pairs of small messages:
with Nagle's algorithm the second cannot arrive before the first is acknowledged, so every pair is slow. A busy
machine can delay any pair, but not all of them. Chromium always sets TCP_NODELAY.
"""

import contextlib
import http.client
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import topics
from tests.harness.cloud.cloud_processes import CloudProcesses, Link
from tests.harness.network.brokers import BROKERS, HOST, TRANSPORTS, BrokerKind, Client, Transport, wait_until
from tests.harness.network.proxy import Proxy, start_proxy

PAIRS = 40
APART_S = 0.003
"""Interval that prevents the sender from combining both messages in one packet [s]."""
QUICK_MS = 30.0
"""Below any delayed acknowledgement: 40 ms, which kernels measure in steps of 4 ms."""
QUICK_SHARE = 0.25
BAND_MS = 10.0
SPIKE_SHARE = 0.2

Send = Callable[[bytes], object]


def gaps_ms(proxy: Proxy, send: Send, *, from_server: bool) -> list[float]:
    """Time between the arrivals of both messages of each pair."""
    proxy.acknowledge_late()
    found = []
    for number in range(PAIRS):
        marks = [b"first-%d." % number, b"second-%d." % number]
        send(b'{"mark": "%s"}' % marks[0])
        time.sleep(APART_S)
        send(b'{"mark": "%s"}' % marks[1])
        first_s, second_s = (arrival_s(proxy, mark, from_server=from_server) for mark in marks)
        found.append((second_s - first_s) * 1000)
    return found


def arrival_s(proxy: Proxy, mark: bytes, *, from_server: bool) -> float:
    found: list[float] = []

    def arrived() -> bool:
        found[:] = [at_s for at_s, back, content in proxy.arrivals if back is from_server and mark in content]
        return bool(found)

    wait_until(arrived, f"{mark!r} to arrive")
    return found[0]


def delayed(gaps: list[float]) -> bool:
    """Whether acknowledgements delay messages: few pairs are quick, or a fifth of them accumulate near 40 ms."""

    def share(low_ms: float, high_ms: float) -> float:
        return sum(low_ms <= each < high_ms for each in gaps) / len(gaps)

    peak, before, after = (share(begin, begin + BAND_MS) for begin in (36.0, 36.0 - BAND_MS, 36.0 + BAND_MS))
    return share(0, QUICK_MS) < QUICK_SHARE or peak - max(before, after) > SPIKE_SHARE


@pytest.mark.parametrize("no_delay", [False, True], ids=["Nagle", "TCP_NODELAY"])
def test_the_measurement_detects_nagles_algorithm(no_delay: bool) -> None:
    with socket.create_server((HOST, 0)) as listener, start_proxy(listener.getsockname()[1]) as proxy:
        threading.Thread(target=swallow, args=(listener,), daemon=True).start()
        with socket.create_connection((HOST, proxy.port)) as opened:
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, no_delay)
            gaps = gaps_ms(proxy, opened.sendall, from_server=False)
    assert delayed(gaps) is not no_delay, gaps


def swallow(listener: socket.socket) -> None:
    accepted, _ = listener.accept()
    with accepted:
        while accepted.recv(4096):
            pass


def test_an_accumulation_among_quick_pairs_is_detected_and_a_slow_machine_is_not() -> None:
    assert delayed([1.0] * 30 + [41.0] * 10)
    assert not delayed([float(each) for each in range(1, 80, 2)])


@contextlib.contextmanager
def client(
    processes: CloudProcesses, name: str, *, publish: str = "#", subscribe: str = "#", **options: Any
) -> Iterator[Client]:
    """A connected client with these rights, behind the port in ``options`` if there is one."""
    broker, functions = processes.broker.running, processes.cloud.functions
    login = processes.cloud.run(functions.access.issue(broker.grant(name, publish=(publish,), subscribe=(subscribe,))))
    port = options.pop("port", 0) or broker.port(options.get("transport", "tcp"))
    with Client(name, login, port=port, **options).open() as found:
        assert found.connected.is_set(), found.answer
        yield found


@pytest.fixture(params=["mqtt", "xmpp"])
def link(request: pytest.FixtureRequest, start_processes: Callable[[Any], CloudProcesses]) -> Iterator[Link]:
    """An agent's transport behind a proxy."""
    if request.param == "mqtt":
        processes, endpoint = start_processes("amqtt"), "broker"
    else:
        processes, endpoint = request.getfixturevalue("xmpp_processes"), "xmpp"
    with Link(processes, {"transport": request.param}, through=endpoint).start() as link:
        yield link.up()


def test_an_agent_publishes_without_delay(link: Link) -> None:
    assert link.proxy is not None
    topic = link.topic(topics.TELE, "joints")
    gaps = gaps_ms(link.proxy, lambda mark: link.transport.publish(topic, mark, qos=0), from_server=False)
    assert not delayed(gaps), gaps


def test_an_agent_receives_setpoints_without_delay(link: Link) -> None:
    assert link.proxy is not None
    topic = f"{link.topic(topics.CTL)}/1"
    with client(link.processes, "operator") as operator:
        wait_until(lambda: operator.publish(topic, b"{}", qos=0) and link.received, "the first setpoint")
        gaps = gaps_ms(link.proxy, lambda mark: operator.publish(topic, mark, qos=0), from_server=True)
    assert not delayed(gaps), gaps


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("kind", BROKERS)
def test_a_broker_delivers_without_delay(
    start_processes: Callable[[BrokerKind], CloudProcesses], kind: BrokerKind, transport: Transport
) -> None:
    processes, topic = start_processes(kind), "ts/v1/lab/robot/arm/tele/joints"
    with (
        start_proxy(processes.broker.running.port(transport)) as proxy,
        client(processes, "page", subscribe=topic, port=proxy.port, transport=transport) as page,
        client(processes, "robot", publish=topic) as robot,
    ):
        page.subscribe(topic, qos=0)
        gaps = gaps_ms(proxy, lambda mark: robot.publish(topic, mark, qos=0), from_server=True)
    assert not delayed(gaps), gaps


def test_the_functions_publish_without_delay(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
    """Checks socket options, because messages that are acknowledged one by one hide the delay."""
    processes = start_processes("amqtt")
    processes.publish_retained("ts/v1/lab/robot/arm/state", b"{}")
    options = no_delay_options(processes.broker.port)
    assert options
    assert all(options), options


def no_delay_options(port: int) -> list[bool]:
    """For each connection of this process to a port: whether TCP_NODELAY is set."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # no socket, not connected, or closed meanwhile
            if not str(entry.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry.name))) as opened:
                if opened.family == socket.AF_INET and opened.getpeername()[1] == port:
                    found.append(opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0)
    return found


def test_the_functions_respond_over_http_without_delay(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
    """Head and body of a response are two writes."""
    with start_proxy(start_processes("amqtt").endpoints["server"].port) as proxy:
        proxy.acknowledge_late()
        connection = http.client.HTTPConnection(HOST, proxy.port, timeout=60)
        gaps = []
        for _ in range(PAIRS):
            proxy.arrivals.clear()
            connection.request("GET", "/api/v1/health")
            assert connection.getresponse().read()
            arrivals_s = [at_s for at_s, back, _ in proxy.arrivals if back]
            gaps.append((arrivals_s[-1] - arrivals_s[0]) * 1000)
        connection.close()
    assert not delayed(gaps), gaps


def test_an_agent_sends_over_http_without_delay(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
    """Head and body of a request are two writes."""
    with Link(start_processes("amqtt"), {"transport": "http"}, through="server").start() as link:
        link.up()
        assert link.proxy is not None
        link.proxy.acknowledge_late()
        gaps = []
        for number in range(PAIRS):
            mark = b"body-%d." % number
            link.transport.publish(link.topic(topics.EVENT), b'{"mark": "%s"}' % mark, qos=1)
            body_s = arrival_s(link.proxy, mark, from_server=False)
            heads_s = [at_s for at_s, back, content in link.proxy.arrivals if not back and content.startswith(b"POST ")]
            gaps.append((body_s - max(at_s for at_s in heads_s if at_s <= body_s)) * 1000)
    assert not delayed(gaps), gaps
