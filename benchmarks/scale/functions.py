"""The API with 1, 2 and 4 processes over one store, compared with a bare FastAPI application."""

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from benchmarks.baseline.echo_servers import HOST
from benchmarks.baseline.product import TIMEOUT_S, MeasuredProduct, start, start_peer
from benchmarks.reporting.report import Cell, Chart, Claim, Table
from benchmarks.scale.brokers import program, request
from benchmarks.scale.http_load import HttpLoad, HttpLoadResult, Request
from benchmarks.scale.processes import processor_s
from tests.harness.network.ports import free_port
from tests.harness.paths import ROOT

CONNECTIONS: Final = 16
PROCESSES: Final = (1, 2, 4)
MIN_RATIO: Final = 0.4
UNLIMITED: Final = {f"TELESCOPE_RATE_{name}": "0" for name in ("ADDRESS", "ACCOUNT", "KEY", "AGENT")}
LIST: Final = "GET devices"
ONE: Final = "GET devices/{id}"
BARE: Final = "bare FastAPI"
COLUMNS: Final = [
    "processes", "request", "bytes", "requests/s", "p50 ms", "p99 ms", "rejected",
    "functions, µs of a core per request", "functions, % of a core", "clients, %",
]  # fmt: skip


class Load(msgspec.Struct):
    """Result of one kind of request over some seconds."""

    processes: int
    name: str
    result: HttpLoadResult
    server_s: float

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        result = self.result
        return [
            self.processes, self.name, result.response_bytes, result.per_s, result.p50_ms, result.p99_ms,
            sum(result.rejected.values()), self.server_s / max(result.count, 1) * 1e6,
            *(100 * spent / result.duration_s for spent in (self.server_s, result.processor_s)),
        ]  # fmt: skip


RunLoad = Callable[[float], Load]


class FunctionsUnderTest:
    """A running product with additional processes of its functions.

    Args:
        product: The product.
        stack: Stops what is started.
    """

    def __init__(self, product: MeasuredProduct, stack: contextlib.ExitStack) -> None:
        self._product = product
        self._stack = stack
        self.device: dict[str, Any] = product.api.device()
        self.pids = [product.machine.pid("function_app serve")]
        self.ports = [product.machine.port]

    def grow(self, count: int) -> None:
        """Starts processes up to a number."""
        while len(self.pids) < count:
            port = free_port()
            process = self._stack.enter_context(_functions(self._product, port))
            self.ports.append(port)
            self.pids.append(process.pid)

    def clients(self, name: str, processes: int, requests: list[Request], stack: contextlib.ExitStack) -> RunLoad:
        """Returns connected clients of the first processes."""
        return start_clients(stack, name, self.ports[:processes], self.pids[:processes], requests)

    def read(self, name: str, processes: int, stack: contextlib.ExitStack) -> RunLoad:
        """Returns clients that read."""
        path = "/api/v1/devices" if name == LIST else f"/api/v1/devices/{self.device['id']}"
        return self.clients(name, processes, [Request("GET", path, self._product.token)], stack)


def start_clients(
    stack: contextlib.ExitStack, name: str, ports: list[int], pids: list[int], requests: list[Request]
) -> RunLoad:
    """Starts clients for some servers."""
    client_program = stack.enter_context(program("http_load", HttpLoad(ports, CONNECTIONS, requests)))

    def run(seconds: float) -> Load:
        before_s = sum(map(processor_s, pids))
        result = msgspec.json.decode(request(client_program, str(seconds)), type=HttpLoadResult)
        return Load(len(ports), name, result, sum(map(processor_s, pids)) - before_s)

    return run


@contextlib.contextmanager
def _functions(product: MeasuredProduct, port: int) -> Iterator["subprocess.Popen[bytes]"]:
    """Starts one more process of the functions and returns when it responds."""
    first = product.machine.port
    environment = (
        os.environ
        | UNLIMITED
        | {
            "TELESCOPE_HOME": str(product.machine.home),
            "TELESCOPE_HOST": HOST,
            "TELESCOPE_PORT": str(port),
            "TELESCOPE_MQTT_PORT": str(first + 1),
            "TELESCOPE_WEBSOCKET_PORT": str(first + 2),
            "TELESCOPE_BROKER": product.kind,
        }
    )
    with subprocess.Popen([sys.executable, "-m", "function_app", "serve"], cwd=ROOT, env=environment) as process:
        try:
            deadline_s = time.monotonic() + TIMEOUT_S
            while not _healthy(port):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise RuntimeError("an additional process of the functions did not start")
                time.sleep(0.1)
            yield process
        finally:
            process.terminate()


def _healthy(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://{HOST}:{port}/api/v1/health", timeout=5) as response:
            return bool(json.load(response)["broker"] == "ok")
    except (urllib.error.URLError, OSError, ValueError):
        return False


def measure(site: FunctionsUnderTest, *, quick: bool, log: Callable[[str], None]) -> tuple[list[Load], list[Load]]:
    """Measures reads of one process interleaved with the bare application, then of more processes."""
    seconds, rounds = (1.5, 3) if quick else (2.5, 5)
    with contextlib.ExitStack() as stack:
        loads = {what: site.read(what, 1, stack) for what in (LIST, ONE)}
        loads[BARE] = bare(stack, loads[ONE](0.3).result.response_bytes)
        found: dict[str, list[Load]] = {what: [] for what in loads}
        for _ in range(rounds):
            for what, run in loads.items():
                found[what].append(run(seconds))
    one, more = [median_of(each) for each in found.values()], []
    for load in one:
        log(f"{load.name}: {load.result.per_s:.0f} requests/s, p99 {load.result.p99_ms:.1f} ms")
    for count in PROCESSES[1:]:
        site.grow(count)
        for what in (LIST, ONE):
            with contextlib.ExitStack() as stack:
                run = site.read(what, count, stack)
                run(0.3)
                more.append(run(seconds))
        log(f"{count} processes: {more[-1].result.per_s:.0f} requests/s")
    return one, more


@contextlib.contextmanager
def started() -> Iterator[tuple[MeasuredProduct, FunctionsUnderTest]]:
    """Runs the product with one simulated UR5 over mosquitto, without rate limits."""
    with contextlib.ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        product = stack.enter_context(start(home, "mosquitto", **UNLIMITED))
        yield product, FunctionsUnderTest(product, stack)


def bare(stack: contextlib.ExitStack, length: int) -> RunLoad:
    """Runs the bare application: the same number of JSON bytes, framework and server."""
    port = free_port()
    process = stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "http", str(port)))
    return start_clients(stack, BARE, [port], [process.pid], [Request("GET", f"/sized/{length}")])


def median_of(loads: list[Load]) -> Load:
    """Returns the median run by requests per second."""
    median = statistics.median_low([load.result.per_s for load in loads])
    return next(load for load in loads if load.result.per_s == median)


def table(one: list[Load], more: list[Load]) -> Table:
    """Returns the table of all runs."""
    note = f"""{CONNECTIONS} connections in one program, each with one request at a time, spread over the processes: p50
and p99 are those of a saturated server. Processes and clients share two cores: the clients limit the gain of a second
process, and four processes show the overhead. Each read uses an API key: identity, role, device, presence, state and
lease. The store is SQLite. The {BARE} application returns the same number of bytes without checks. One process and the
bare application ran interleaved; the table shows the median run."""
    return Table(title="API, reading", columns=COLUMNS, rows=[load.row() for load in one + more], note=note)


def chart(one: list[Load], more: list[Load]) -> Chart:
    """Returns the chart of requests per second by number of processes."""
    per_s = {(load.name, load.processes): load.result.per_s for load in one + more}
    return Chart(
        title="Authenticated reads over one store, two cores",
        kind="bar",
        x_label="processes of the functions",
        y_label="requests/s",
        x=[str(count) for count in PROCESSES],
        series={name: [per_s.get((name, count)) for count in PROCESSES] for name in (LIST, ONE)},
        marks={f"{BARE}, one process": per_s[BARE, 1]},
    )


def actions_table(loads: list[Load]) -> Table:
    """Returns the table of started actions."""
    note = """The same clients, each with its own load-test arms; each starts the next action when one is done:
identity, role, slot and action in one write, signature, publish, the robot's acknowledgements and their writes. The
arms are at their target and report it with the next measurement, within 50 ms. Load test, broker and worker share the
cores."""
    return Table(
        title="API, actions from the request to done", columns=COLUMNS, rows=[load.row() for load in loads], note=note
    )


def claims(one: list[Load]) -> list[Claim]:
    """Returns the targets for one process."""
    by_name = {load.name: load.result.per_s for load in one}
    return [
        Claim(
            f"`{what}` by one process, authenticated, to a bare FastAPI's requests/s",
            by_name[what] / by_name[BARE],
            MIN_RATIO,
            "×",
            at_least=True,
        )
        for what in (LIST, ONE)
    ]
