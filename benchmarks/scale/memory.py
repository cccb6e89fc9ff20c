"""Memory of one more connection at a broker and at the functions."""

import contextlib
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks.baseline.echo_servers import HOST
from benchmarks.baseline.product import TIMEOUT_S
from benchmarks.reporting.report import Cell, Table
from benchmarks.scale import mqtt_packets
from benchmarks.scale.functions import FunctionsUnderTest
from benchmarks.scale.http_load import Request
from benchmarks.scale.processes import resident_mb
from tests.harness.network.brokers import BROKERS, BrokerKind, start_broker

COLUMNS: Final = ["", "connections", "MB", "kB per connection"]
_RESPONSE_BYTES: Final = 65_536


def measure(site: FunctionsUnderTest, *, quick: bool, log: Callable[[str], None]) -> Table:
    """Opens an increasing number of idle connections."""
    steps = (100,) if quick else (100, 200, 400)
    rows: list[list[Cell]] = []
    for kind in BROKERS:
        rows += broker(kind, steps)
    rows += functions(site, steps)
    log("; ".join(f"{row[0]}: {row[3]:.0f} kB per connection" for row in rows if row[1] == steps[-1]))
    note = """Memory of the program and its children (proportional set size). Each client of a broker
has its own credentials and one subscription; mosquitto also keeps their permissions in memory. Each client of the
functions sent one request."""
    return Table(title="Memory by connections", columns=COLUMNS, rows=rows, note=note)


def broker(kind: BrokerKind, steps: tuple[int, ...]) -> list[list[Cell]]:
    """Measures a broker with the product's configuration."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        running = stack.enter_context(start_broker(kind, folder))
        connections: list[socket.socket] = []

        def grow(count: int) -> None:
            while len(connections) < count:
                name = f"idle-{len(connections)}"
                topic = f"ts/v1/lab/{name}/arm/cmd"
                issued = running.issue(running.grant(name, subscribe=(topic,)))
                connection = mqtt_packets.connect(running.tcp_port, name, issued.username, issued.password)
                connections.append(stack.enter_context(connection))
                mqtt_packets.subscribe(connection, topic)

        grow(1)  # the connection of the functions that issues permissions exists from the start
        return _rows(kind, running.process.pid, steps, grow)


def functions(site: FunctionsUnderTest, steps: tuple[int, ...]) -> list[list[Cell]]:
    """Measures one process of the functions."""
    with contextlib.ExitStack() as stack:
        connections: list[socket.socket] = []
        request = Request("GET", "/api/v1/unknown").encode()

        def grow(count: int) -> None:
            while len(connections) < count:
                connection = stack.enter_context(socket.create_connection((HOST, site.ports[0]), TIMEOUT_S))
                connection.sendall(request)
                connection.recv(_RESPONSE_BYTES)
                connections.append(connection)

        return _rows("functions", site.pids[0], steps, grow)


def _rows(name: str, pid: int, steps: tuple[int, ...], grow: Callable[[int], None]) -> list[list[Cell]]:
    before = resident_mb(pid)
    rows: list[list[Cell]] = [[name, 0, before, None]]
    for count in steps:
        grow(count)
        now = resident_mb(pid)
        rows.append([name, count, now, (now - before) / count * 1000])
    return rows
