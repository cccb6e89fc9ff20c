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
from benchmarks.baseline.product import TIMEOUT_S, MeasuredProduct, free_port, start, start_peer
from benchmarks.reporting.report import Cell, Chart, Claim, Table
from benchmarks.scale.brokers import answer, program
from benchmarks.scale.http_load import HttpLoad, HttpLoadResult, Request
from benchmarks.scale.processes import processor_s
from tests.harness.paths import ROOT

CONNECTIONS: Final = 16
PROCESSES: Final = (1, 2, 4)
LEAST: Final = 0.4
UNLIMITED: Final = {f"TELESCOPE_RATE_{name}": "0" for name in ("ADDRESS", "ACCOUNT", "KEY", "AGENT")}
LIST: Final = "GET devices"
ONE: Final = "GET devices/{id}"
BARE: Final = "bare FastAPI"
COLUMNS: Final = [
    "processes", "asked", "bytes", "requests/s", "p50 ms", "p99 ms", "refused", "functions, µs of a core a request",
    "functions, % of a core", "clients, %",
]  # fmt: skip


class Load(msgspec.Struct):
    """Result of one kind of request over some seconds."""

    processes: int
    what: str
    answered: HttpLoadResult
    server_s: float

    def row(self) -> list[Cell]:
        """Returns the row for the results page."""
        found = self.answered
        return [
            self.processes, self.what, found.answer_bytes, found.per_s, found.p50_ms, found.p99_ms,
            sum(found.refused.values()), self.server_s / max(found.count, 1) * 1e6,
            *(100 * spent / found.took_s for spent in (self.server_s, found.processor_s)),
        ]  # fmt: skip


Ask = Callable[[float], Load]


class FunctionsUnderTest:
    """A running product with additional processes of its functions.

    Args:
        stand: The product.
        stack: Stops what is started.
    """

    def __init__(self, stand: MeasuredProduct, stack: contextlib.ExitStack) -> None:
        self._stand = stand
        self._stack = stack
        self.device: dict[str, Any] = stand.api.device()
        self.pids = [stand.machine.pid("function_app serve")]
        self.ports = [stand.machine.port]

    def grow(self, count: int) -> None:
        """Starts processes up to a number."""
        while len(self.pids) < count:
            port = free_port()
            process = self._stack.enter_context(_functions(self._stand, port))
            self.ports.append(port)
            self.pids.append(process.pid)

    def ask(self, what: str, processes: int, requests: list[Request], stack: contextlib.ExitStack) -> Ask:
        """Returns connected clients of the first processes."""
        return clients(stack, what, self.ports[:processes], self.pids[:processes], requests)

    def read(self, what: str, processes: int, stack: contextlib.ExitStack) -> Ask:
        """Returns clients that read."""
        path = "/api/v1/devices" if what == LIST else f"/api/v1/devices/{self.device['id']}"
        return self.ask(what, processes, [Request("GET", path, self._stand.token)], stack)


def clients(stack: contextlib.ExitStack, what: str, ports: list[int], pids: list[int], requests: list[Request]) -> Ask:
    """Starts clients for some servers."""
    asker = stack.enter_context(program("http_load", HttpLoad(ports, CONNECTIONS, requests)))

    def ask(seconds: float) -> Load:
        before_s = sum(map(processor_s, pids))
        answered = msgspec.json.decode(answer(asker, str(seconds)), type=HttpLoadResult)
        return Load(len(ports), what, answered, sum(map(processor_s, pids)) - before_s)

    return ask


@contextlib.contextmanager
def _functions(stand: MeasuredProduct, port: int) -> Iterator["subprocess.Popen[bytes]"]:
    """Starts one more process of the functions and returns when it responds."""
    first = stand.machine.port
    environment = (
        os.environ
        | UNLIMITED
        | {
            "TELESCOPE_HOME": str(stand.machine.home),
            "TELESCOPE_HOST": HOST,
            "TELESCOPE_PORT": str(port),
            "TELESCOPE_MQTT_PORT": str(first + 1),
            "TELESCOPE_WEBSOCKET_PORT": str(first + 2),
            "TELESCOPE_BROKER": stand.kind,
        }
    )
    with subprocess.Popen([sys.executable, "-m", "function_app", "serve"], cwd=ROOT, env=environment) as process:
        try:
            ends_s = time.monotonic() + TIMEOUT_S
            while not _healthy(port):
                if process.poll() is not None or time.monotonic() > ends_s:
                    raise RuntimeError("another process of the functions does not start")
                time.sleep(0.1)
            yield process
        finally:
            process.terminate()


def _healthy(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://{HOST}:{port}/api/v1/health", timeout=5) as found:
            return bool(json.load(found)["broker"] == "ok")
    except (urllib.error.URLError, OSError, ValueError):
        return False


def measure(site: FunctionsUnderTest, *, quick: bool, say: Callable[[str], None]) -> tuple[list[Load], list[Load]]:
    """Measures reads of one process interleaved with the bare application, then of more processes."""
    seconds, rounds = (1.5, 3) if quick else (2.5, 5)
    with contextlib.ExitStack() as stack:
        turns = {what: site.read(what, 1, stack) for what in (LIST, ONE)}
        turns[BARE] = bare(stack, turns[ONE](0.3).answered.answer_bytes)
        found: dict[str, list[Load]] = {what: [] for what in turns}
        for _ in range(rounds):
            for what, ask in turns.items():
                found[what].append(ask(seconds))
    best, more = [median_of(loads) for loads in found.values()], []
    for load in best:
        say(f"{load.what}: {load.answered.per_s:.0f} requests/s, p99 {load.answered.p99_ms:.1f} ms")
    for count in PROCESSES[1:]:
        site.grow(count)
        for what in (LIST, ONE):
            with contextlib.ExitStack() as stack:
                ask = site.read(what, count, stack)
                ask(0.3)
                more.append(ask(seconds))
        say(f"{count} processes: {more[-1].answered.per_s:.0f} requests/s")
    return best, more


@contextlib.contextmanager
def started() -> Iterator[tuple[MeasuredProduct, FunctionsUnderTest]]:
    """Runs the product with one simulated UR5 over mosquitto, without rate limits."""
    with contextlib.ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stand = stack.enter_context(start(home, "mosquitto", **UNLIMITED))
        yield stand, FunctionsUnderTest(stand, stack)


def bare(stack: contextlib.ExitStack, length: int) -> Ask:
    """Runs the bare application: the same number of JSON bytes, framework and server."""
    port = free_port()
    process = stack.enter_context(start_peer("benchmarks.baseline.echo_servers", "http", str(port)))
    return clients(stack, BARE, [port], [process.pid], [Request("GET", f"/sized/{length}")])


def median_of(loads: list[Load]) -> Load:
    """Returns the median run by requests per second."""
    wanted = statistics.median_low([load.answered.per_s for load in loads])
    return next(load for load in loads if load.answered.per_s == wanted)


def table(one: list[Load], more: list[Load]) -> Table:
    """Returns the table of all runs."""
    note = f"""{CONNECTIONS} connections that ask one request after the other, in one program, spread over the
processes: p50 and p99 are of a server that is full. Processes and clients share two cores: two processes are no
faster than what the clients leave of the second allows, and four show what more of them cost. Each reads by an
API key: identity, role, device, presence, state and lease. SQLite is the store; the {BARE} application answers
as many bytes and looks at nothing. Of one process and the bare one, which took turns, the run in the middle."""
    return Table(title="API, reading", columns=COLUMNS, rows=[load.row() for load in one + more], note=note)


def chart(one: list[Load], more: list[Load]) -> Chart:
    """Returns the chart of requests per second by number of processes."""
    per_s = {(load.what, load.processes): load.answered.per_s for load in one + more}
    return Chart(
        title="Authenticated reads over one store, two cores",
        kind="bar",
        x_label="processes of the functions",
        y_label="requests/s",
        x=[str(count) for count in PROCESSES],
        series={what: [per_s.get((what, count)) for count in PROCESSES] for what in (LIST, ONE)},
        marks={f"{BARE}, one process": per_s[BARE, 1]},
    )


def actions_table(loads: list[Load]) -> Table:
    """Returns the table of started actions."""
    note = """The same clients, each with arms of a swarm of its own, and on to the next action when one is
done: identity, role, slot and action in one write, signature, publish, the robot's answers, and their writes.
The arms are where they are asked to be, and notice it at their next measurement, within 50 ms. Swarm, broker
and the worker that takes in what robots tell run on the same cores."""
    return Table(
        title="API, actions from the request to done", columns=COLUMNS, rows=[load.row() for load in loads], note=note
    )


def claims(one: list[Load]) -> list[Claim]:
    """Returns the targets for one process."""
    by_name = {load.what: load.answered.per_s for load in one}
    return [
        Claim(
            f"`{what}` by one process, authenticated, to a bare FastAPI's requests/s",
            by_name[what] / by_name[BARE],
            LEAST,
            "×",
            at_least=True,
        )
        for what in (LIST, ONE)
    ]
