"""The delay forwards each byte in order after the configured time, and stalls dropped segments."""

import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from tests.harness.network.brokers import HOST
from tests.harness.network.delay import RTO_MIN_S, start_delay

RTT_S = 0.04


@contextmanager
def line(rtt_ms: float, loss: float = 0.0) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Both ends of one connection through a delay."""
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
        with (
            start_delay(port, rtt_ms=rtt_ms, loss=loss) as way,
            socket.create_connection((HOST, way.ports[port]), 10) as client,
        ):
            server.settimeout(10)
            accepted, _ = server.accept()
            with closing(accepted):
                accepted.settimeout(10)
                yield client, accepted


def read(end: socket.socket, count: int) -> bytes:
    found = b""
    while len(found) < count:
        found += end.recv(count - len(found))
    return found


@pytest.fixture(scope="module")
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    with line(RTT_S * 1000) as both:
        yield both


def test_a_new_connection_costs_a_round_trip_more_and_each_message_half_of_one() -> None:
    with line(RTT_S * 1000) as (client, server):
        began = time.monotonic()
        client.sendall(b"a")
        read(server, 1)
        assert time.monotonic() - began >= 1.4 * RTT_S, "the handshake is not made up for"
        began = time.monotonic()
        server.sendall(b"b")
        read(client, 1)
        assert time.monotonic() - began >= RTT_S / 2


def test_all_comes_in_order(ends: tuple[socket.socket, socket.socket]) -> None:
    client, server = ends
    sent = bytes(range(256)) * 400
    for start in range(0, len(sent), 10_000):
        client.sendall(sent[start : start + 10_000])
    assert read(server, len(sent)) == sent


def test_the_end_of_a_connection_comes_after_what_was_said_before_it() -> None:
    with line(RTT_S * 1000) as (client, server):
        client.sendall(b"last")
        client.shutdown(socket.SHUT_WR)
        assert read(server, 4) == b"last"
        assert server.recv(1) == b""


def test_what_is_lost_comes_a_retransmission_later_and_holds_up_what_follows() -> None:
    with line(0, loss=1.0) as (client, server):
        began = time.monotonic()
        client.sendall(b"a")
        read(server, 1)
        assert time.monotonic() - began >= RTO_MIN_S


def test_the_client_is_disconnected_without_a_server() -> None:
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
    with start_delay(port, rtt_ms=0) as way, socket.create_connection((HOST, way.ports[port]), 10) as client:
        client.settimeout(10)
        assert client.recv(1) == b""
