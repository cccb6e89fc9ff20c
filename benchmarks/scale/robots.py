"""Number of robots per agent: processor time, memory and lateness of the control loops."""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, Literal

import msgspec

from benchmarks.baseline.product import MeasuredProduct
from benchmarks.reporting.report import Cell, Chart, Table
from benchmarks.scale.agent import DIVIDER, LIGHT, LoopStatistics
from benchmarks.scale.processes import processor_s, resident_mb
from tests.harness.browser.product import Api
from tests.harness.paths import ROOT

Kind = Literal["light", "simulated"]
PERIOD_MS: Final = 8.0
"""Control period of the UR5."""
FULL: Final[tuple[tuple[Kind, float, int, tuple[int, ...]], ...]] = (
    ("light", 50.0, 1, (1, 8, 32, 64)),
    ("light", 20.0, 1, (64,)),
    ("light", 50.0, 2, (32,)),
    ("simulated", 50.0, 1, (1, 8, 16, 24)),
    ("simulated", 20.0, 1, (24,)),
    ("simulated", 50.0, 2, (12,)),
)
"""Kind of robot, telemetry rate [Hz], number of agents and robots per agent."""
QUICK: Final[tuple[tuple[Kind, float, int, tuple[int, ...]], ...]] = (
    ("light", 50.0, 1, (8,)),
    ("simulated", 50.0, 1, (4,)),
)
CHARTED_HZ: Final = 50.0
_SETTLE_S: Final = 2.0
_OBSERVE_S: Final = 3.0
COLUMNS: Final = [
    "agents × robots", "", "telemetry Hz", "agents, % of a core", "late p50 ms", "late p99 ms", "max ms", "in time",
    "MB per agent", "MB per robot",
]  # fmt: skip


class AgentProcess(msgspec.Struct):
    """Robots of one or several agents; the lateness is that of the worst agent."""

    kind: Kind
    rate_hz: float
    agents: int
    count: int
    statistics: LoopStatistics
    percent: float
    mb: float

    @property
    def in_time(self) -> bool:
        """True if 99 % of the decisions are less than one period late."""
        return self.statistics.late_p99_ms < PERIOD_MS

    def row(self, alone_mb: float | None) -> list[Cell]:
        """Returns the row for the results page; ``alone_mb`` is the memory of an agent with one robot."""
        each = None if alone_mb is None or self.count == 1 else (self.mb - alone_mb) / (self.count - 1)
        return [
            f"{self.agents} × {self.count}", self.kind, self.rate_hz, self.percent,
            max(0.0, self.statistics.late_p50_ms), self.statistics.late_p99_ms, self.statistics.late_max_ms,
            "yes" if self.in_time else "no", self.mb, each,
        ]  # fmt: skip


def measure(product: MeasuredProduct, *, quick: bool, log: Callable[[str], None]) -> list[AgentProcess]:
    """Adds robots until they are late."""
    found: list[AgentProcess] = []
    for kind, rate_hz, agents, counts in QUICK if quick else FULL:
        for count in counts:
            found.append(run_agents(product, kind, rate_hz, agents, count))
            log(
                f"{agents} × {count} {kind} robots at {rate_hz:g} Hz: {found[-1].percent:.0f} % of a core, "
                f"late p99 {found[-1].statistics.late_p99_ms:.1f} ms"
            )
            if not found[-1].in_time:
                break
    return found


def run_agents(product: MeasuredProduct, kind: Kind, rate_hz: float, agents: int, count: int) -> AgentProcess:
    """Runs agents with a number of robots each and observes them for some seconds."""
    with contextlib.ExitStack() as stack:
        homes = [Path(stack.enter_context(tempfile.TemporaryDirectory())) for _ in range(agents)]
        for home in homes:
            pair(product, home, kind, count)
        processes = [stack.enter_context(running(home, rate_hz)) for home in homes]
        pool = stack.enter_context(ThreadPoolExecutor(agents))

        def observe_all(seconds: float) -> list[LoopStatistics]:
            return list(pool.map(lambda process: observe(process, seconds), processes))

        observe_all(_SETTLE_S)
        before_s, started_s = sum(processor_s(each.pid) for each in processes), time.monotonic()
        statistics = max(observe_all(_OBSERVE_S), key=lambda each: each.late_p99_ms)
        percent = 100 * (sum(processor_s(each.pid) for each in processes) - before_s) / (time.monotonic() - started_s)
        return AgentProcess(kind, rate_hz, agents, count, statistics, percent, resident_mb(processes[0].pid))


def pair(product: MeasuredProduct, home: Path, kind: Kind, count: int) -> None:
    """Enrols an agent and claims it with the demo account; an API key may not claim."""
    driver = f":{LIGHT}" if kind == "light" else ""
    devices = [word for number in range(count) for word in ("--device", f"arm_{number}=ur5{driver}")]
    server = ("--server", product.machine.url, "--name", "bench", "--no-wait", "--no-qr")
    output = subprocess.run(
        [*program(20.0), "enroll", "--home", str(home), *server, *devices],
        cwd=ROOT, capture_output=True, text=True, check=True, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    words = output.stdout.split()
    with Api(product.machine) as owner:
        owner.post("/agents/claim", {"code": words[words.index("code") + 1]})


def program(rate_hz: float) -> list[str]:
    """Returns the command of the observed agent."""
    return [sys.executable, "-m", "benchmarks.scale.agent", str(rate_hz), DIVIDER]


@contextlib.contextmanager
def running(home: Path, rate_hz: float) -> Iterator["subprocess.Popen[str]"]:
    """Starts the agent and returns when its robots run."""
    with (
        (home / "log").open("w") as log_file,
        subprocess.Popen(
            [*program(rate_hz), "run", "--home", str(home)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log_file,
            text=True,
        ) as process,
    ):
        try:
            wait_for_line(process, "running")
            yield process
        finally:
            process.terminate()


def observe(process: "subprocess.Popen[str]", seconds: float) -> LoopStatistics:
    """Observes the control loops from now on."""
    assert process.stdin is not None
    process.stdin.write(f"{seconds}\n")
    process.stdin.flush()
    return msgspec.json.decode(wait_for_line(process, "statistics").partition(" ")[2], type=LoopStatistics)


def wait_for_line(process: "subprocess.Popen[str]", prefix: str) -> str:
    """Returns the next line with a prefix.

    Raises:
        RuntimeError: The program ended.
    """
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(prefix):
            return line
    raise RuntimeError(f"the agent ended with exit code {process.wait()}")


def chart(found: list[AgentProcess]) -> Chart | None:
    """Returns the chart of lateness by number of robots."""
    one = [each for each in found if each.agents == 1 and each.rate_hz == CHARTED_HZ]
    counts = sorted({each.count for each in one})
    kinds = {each.kind for each in one}
    if len(counts) <= len(kinds):
        return None
    late = {(each.kind, each.count): each.statistics.late_p99_ms for each in one}
    return Chart(
        title=f"Control periods of one agent, telemetry at {CHARTED_HZ:g} Hz",
        kind="bar",
        x_label="robots",
        y_label="late, p99 ms",
        x=[str(count) for count in counts],
        series={kind: [late.get((kind, count)) for count in counts] for kind in sorted(kinds)},
        marks={"a period": PERIOD_MS},
        log=True,
    )


def ceilings(found: list[AgentProcess]) -> list[str]:
    """Returns the largest number of robots without lateness, per series."""
    tried: dict[tuple[int, Kind, float], list[AgentProcess]] = {}
    for each in found:
        tried.setdefault((each.agents, each.kind, each.rate_hz), []).append(each)
    return [
        f"One agent had {max((each.count for each in series if each.in_time), default=0)} {kind} robots in time at "
        f"{rate_hz:g} Hz."
        for (agents, kind, rate_hz), series in tried.items()
        if agents == 1 and len(series) > 1
    ]


def table(found: list[AgentProcess]) -> Table:
    """Returns the table of results."""
    alone = {each.kind: each.mb for each in found if each.count == 1}
    note = """One agent with a number of UR5 at rest. *Light* robots are always at their commanded position, so
the values show the cost of the agent itself; *simulated* robots have a world with physics each. Late is the time by
which a control period exceeds 8 ms; a robot is in time if 99 % of its periods are less than one period late. The
functions and mosquitto run on the same machine and store the telemetry."""
    note = " ".join([note, *ceilings(found)])
    rows = [each.row(alone.get(each.kind)) for each in found]
    return Table(title="Robots per agent", columns=COLUMNS, rows=rows, note=note)
