"""No connection holds a small message back for the 40 ms of a delayed acknowledgement (TCP_NODELAY missing).

Before each end stands a proxy that acknowledges as late as a kernel may. Two small messages go one after the other:
with Nagle's algorithm the second cannot arrive before the first is acknowledged, so no pair is ever quick. A busy
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
"""So that who sends does not put both into one packet."""
QUICK_MS = 30.0
"""A delayed acknowledgement takes 36 ms at least: 40, and kernels count in steps of 4."""
QUICK_SHARE = 0.25
BAND_MS = 10.0
SPIKE_SHARE = 0.2

Send = Callable[[bytes], object]


def gaps_ms(proxy: Proxy, send: Send, *, from_server: bool) -> list[float]:
    """From the arrival of the first message of each pair to that of the second."""
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

    def came() -> bool:
        found[:] = [at_s for at_s, back, content in proxy.arrivals if back is from_server and mark in content]
        return bool(found)

    wait_until(came, f"{mark!r} to arrive")
    return found[0]


def stepped(gaps: list[float]) -> bool:
    """Whether hardly any pair is quick, or a fifth and more of them are heaped up where such a step is."""

    def share(low_ms: float, high_ms: float) -> float:
        return sum(low_ms <= each < high_ms for each in gaps) / len(gaps)

    heap, before, behind = (share(begin, begin + BAND_MS) for begin in (36.0, 36.0 - BAND_MS, 36.0 + BAND_MS))
    return share(0, QUICK_MS) < QUICK_SHARE or heap - max(before, behind) > SPIKE_SHARE


@pytest.mark.parametrize("at_once", [False, True], ids=["Nagle", "TCP_NODELAY"])
def test_the_measure_tells_a_step_from_none(at_once: bool) -> None:
    with socket.create_server((HOST, 0)) as listener, start_proxy(listener.getsockname()[1]) as proxy:
        threading.Thread(target=swallow, args=(listener,), daemon=True).start()
        with socket.create_connection((HOST, proxy.port)) as opened:
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, at_once)
            gaps = gaps_ms(proxy, opened.sendall, from_server=False)
    assert stepped(gaps) is not at_once, gaps


def swallow(listener: socket.socket) -> None:
    accepted, _ = listener.accept()
    with accepted:
        while accepted.recv(4096):
            pass


def test_a_heap_among_quick_pairs_is_a_step_and_a_slow_machine_is_none() -> None:
    assert stepped([1.0] * 30 + [41.0] * 10)
    assert not stepped([float(each) for each in range(1, 80, 2)])


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


def test_an_agent_publishes_at_once(link: Link) -> None:
    assert link.proxy is not None
    topic = link.topic(topics.TELE, "joints")
    gaps = gaps_ms(link.proxy, lambda mark: link.transport.publish(topic, mark, qos=0), from_server=False)
    assert not stepped(gaps), gaps


def test_an_agent_gets_setpoints_at_once(link: Link) -> None:
    assert link.proxy is not None
    topic = f"{link.topic(topics.CTL)}/1"
    with client(link.processes, "operator") as operator:
        wait_until(lambda: operator.publish(topic, b"{}", qos=0) and link.received, "the first setpoint")
        gaps = gaps_ms(link.proxy, lambda mark: operator.publish(topic, mark, qos=0), from_server=True)
    assert not stepped(gaps), gaps


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("kind", BROKERS)
def test_a_broker_delivers_at_once(
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
    assert not stepped(gaps), gaps


def test_the_functions_send_to_the_broker_at_once(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
    """Their messages are acknowledged one by one, which hides a step; so the options of their sockets are read."""
    processes = start_processes("amqtt")
    processes.publish_retained("ts/v1/lab/robot/arm/state", b"{}")
    options = no_delay_options(processes.broker.port)
    assert options
    assert all(options), options


def no_delay_options(port: int) -> list[bool]:
    """Of each connection of this process to a port, whether it sets TCP_NODELAY."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # no socket, not connected, or closed meanwhile
            if not str(entry.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(entry.name))) as opened:
                if opened.family == socket.AF_INET and opened.getpeername()[1] == port:
                    found.append(opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0)
    return found


def test_the_functions_answer_over_http_at_once(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
    """Head and body of a response are two writes."""
    with start_proxy(start_processes("amqtt").endpoints["server"].port) as proxy:
        proxy.acknowledge_late()
        connection = http.client.HTTPConnection(HOST, proxy.port, timeout=60)
        gaps = []
        for _ in range(PAIRS):
            proxy.arrivals.clear()
            connection.request("GET", "/api/v1/health")
            assert connection.getresponse().read()
            came_s = [at_s for at_s, back, _ in proxy.arrivals if back]
            gaps.append((came_s[-1] - came_s[0]) * 1000)
        connection.close()
    assert not stepped(gaps), gaps


def test_an_agent_sends_over_http_at_once(start_processes: Callable[[BrokerKind], CloudProcesses]) -> None:
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
    assert not stepped(gaps), gaps
