"""The delay proxy forwards each byte in order after the configured time, and stalls lost segments."""

import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from tests.harness.network.brokers import HOST
from tests.harness.network.delay import RTO_MIN_S, start_delay

RTT_S = 0.04
pytestmark = pytest.mark.slow


@contextmanager
def connection(rtt_ms: float, loss: float = 0.0) -> Iterator[tuple[socket.socket, socket.socket, float]]:
    """Both ends of one connection through the proxy, and when its client began to connect [s]."""
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
        with start_delay(port, rtt_ms=rtt_ms, loss=loss) as network:
            began_s = time.monotonic()
            with socket.create_connection((HOST, network.ports[port]), 10) as client:
                server.settimeout(10)
                with closing(server.accept()[0]) as accepted:
                    accepted.settimeout(10)
                    yield client, accepted, began_s


def seconds_to_receive(data: bytes, sender: socket.socket, receiver: socket.socket) -> float:
    started_s = time.monotonic()
    sender.sendall(data)
    received = b""
    while len(received) < len(data):
        received += receiver.recv(len(data) - len(received))
    assert received == data
    return time.monotonic() - started_s


def test_data_is_delayed_and_arrives_in_order_before_the_end() -> None:
    with connection(RTT_S * 1000) as (client, server, began_s):
        seconds_to_receive(b"a", client, server)
        assert time.monotonic() - began_s >= 1.5 * RTT_S, "includes the handshake"
        assert seconds_to_receive(b"b", server, client) >= RTT_S / 2
        seconds_to_receive(bytes(range(256)) * 400, client, server)
        client.sendall(b"last")
        client.shutdown(socket.SHUT_WR)
        with server.makefile("rb") as rest:
            assert rest.read() == b"last"


def test_a_lost_segment_is_delayed_by_a_retransmission() -> None:
    with connection(0, loss=1.0) as (client, server, _):
        assert seconds_to_receive(b"a", client, server) >= RTO_MIN_S


def test_the_client_is_disconnected_without_a_server() -> None:
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
    with start_delay(port, rtt_ms=0) as network, socket.create_connection((HOST, network.ports[port]), 10) as client:
        client.settimeout(10)
        assert client.recv(1) == b""
