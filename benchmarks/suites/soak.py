"""Hours of load on the laboratory: memory, descriptors and errors."""

import contextlib
import os
import re
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from benchmarks.baseline.product import start
from benchmarks.reporting.report import QUICK, Chart, Claim, Report, Table, load
from benchmarks.soak.load import Load
from benchmarks.soak.processes import PARTS, TOTAL, ProcessWatcher, Sample
from benchmarks.soak.trends import DescriptorTrend, after_warm_up, reduced_to_medians

if TYPE_CHECKING:
    from tests.harness.network.brokers import BrokerKind

HOURS: Final = "SOAK_HOURS"
BROKER: Final = "SOAK_BROKER"
"""Environment variables that set the duration of the full run [h] and the broker."""
SERIES: Final = QUICK / "soak.csv"
"""File of all samples; it remains after a killed run."""
_MAX_SLOPE: Final = 1.0
_QUICK_S: Final = 48.0
_FULL_S: Final = 3600.0
"""Shortest run whose result is published."""
_WARM_UP: Final = 1 / 2
_MAX_WARM_UP_S: Final = 3600.0
"""Warm-up: this share of the run, at most this time. A token lasts one hour, the revocation of a client two."""
_LOG_ERROR: Final = re.compile(r"^(?:[-0-9]+ [:,0-9]+ )?((?:ERROR|CRITICAL)\b.*|Traceback .*)", re.MULTILINE)
_PRESSURE: Final = "cpu.pressure"
_ABOUT: Final = """The laboratory as `make up` starts it with {broker}: four robots and a room behind one agent. One
client streams setpoints to the arm and acquires, renews and releases leases, each time with new credentials. Movement
scripts run on all robots; one robot is stopped during every third movement and reset. Two clients subscribe to all
telemetry and reconnect with new credentials. One client signs in, reads resources and signs out. One client shares a
robot with another account, reads all lists and removes the share. `make soak` runs for 8 hours; `SOAK_HOURS` and
`SOAK_BROKER` set another duration and broker. Ctrl-C ends a run with its report. Results of less than an hour, and all
samples, are in `benchmarks/results/quick`."""
_NOTE: Final = """Theil-Sen slopes over medians of one minute, after a warm-up of half the run (at most one hour, the
lifetime of a token), with Sen's 95 % interval; a plus sign means growth. Own memory is
anonymous memory (heap and stack); resident memory includes shared libraries. First and last descriptors and threads
are the lowest tenth of the first and the last tenth of the run after warm-up, of the samples with the most frequent
number of the agent's children, because each running script has its own, also at the agent.
The agent's children are its planner and script sandboxes; their number follows the load."""

_HISTORY: Final = Table(
    title="Memory: effect of changes",
    columns=["change", "minutes", "functions %/h", "worker", "broker", "agent", "total"],
    rows=[
        ["before", 60, 6.9, 0.9, 1.6, 3.3, 3.6],
        ["agents delete confirmed messages; the load reads a constant amount", 34, 9.4, 0.6, 1.1, 0.6, 2.3],
        ["the garbage collector runs as often as by default", 60, 1.5, 2.1, 1.1, 0.5, 1.0],
        ["growth counts after one hour, the lifetime of a token", 114, 0.7, 0.7, 1.9, 0.2, 0.5],
        ["the broker removes expired revocations earlier", 72, 3.2, 3.1, 1.3, 0.4, 1.5],
        ["the same, beside other programs", 120, 1.2, 6.8, 3.4, 0.6, 1.9],
        ["sessions are recorded and uploaded", 99, 3.8, 1.5, 2.5, 1.2, 2.1],
        ["fewer paths; two heaps of the agent", 108, 2.9, 0.0, 2.9, 1.3, 1.5],
        ["account revocations are stored for half an hour", 78, 4.9, 7.9, 4.1, 0.7, 3.7],
        ["lists of blobs keep one entry at a time; idle machine", 99, 0.5, 0.3, 0.4, 1.3, 1.2],
        ["the agent returns large blocks", 120, 0.7, 0.1, 1.8, 0.8, 0.7],
        ["the server's programs return large blocks", 120, 0.2, 0.2, 0.1, 0.8, 0.5],
    ],
    note="""Own memory from the fifteenth minute, one run each (2026-11-22). Agents kept QoS 1 messages that were
confirmed early; the load requested all stored data, so responses grew; the garbage collector of the functions ran as
rarely as during import, so garbage accumulated for ten minutes and more. In the run of 114 minutes (2026-11-28, counted
after one hour), the broker grew by garbage and expired revocations. It now removes both earlier: 2,000 connections one
after the other take it from 23.8 to 24.4 MB, before to 25.3 MB and on to 27.0 MB after 6,000. The run of 72 minutes had
no errors and no additional descriptors. It ends before the first tokens expire, so it shows the growth towards a
plateau: functions and worker grew in single steps of 0.6 to 1.2 MB, and after 55 minutes by 0.2 and 1.6 %/h. The run of
120 minutes (growth counted after one hour) had 24,708 requests, 3,023 actions, no errors and no additional descriptors.
Programs waited for a processor in 80 % of its time. The worker grew by 3.1 MB in steps between minutes 67 and 83, and
not from there to the end (46.5 and 46.3 MB). Its objects were counted in minutes 88 and 96 and had not increased. The
run of 99 minutes (counted after one hour; the total after 49 minutes) had 20,383 requests, 2,497 actions and no errors.
Other programs had idle priority. The functions grew by 0.03 MB per minute, and in three steps of 0.3 to 0.7 MB. In
the run of 108 minutes (2026-11-29, counted after 54 minutes; 21,437 requests, 2,630 actions, no errors, beside programs
with idle priority), functions, worker and agent each made one step of about 1 MB in the first hour. In a run with
more requests per minute, such a step of the functions was Python's table of interned strings, which doubled. The
functions grew by a further 1.5 MB in the second hour. They read all stored sizes for each recorded segment, and no
longer do. The broker grew by 0.01 MB per minute, also with four times as many connections per minute, so its cause
is not the connections; it is not known yet. The worker did not grow after its step. In the run of 78 minutes
(2026-11-29, counted after 39 minutes; 15,108 requests, 1,871 actions, no errors), programs waited for a processor in
90 % of the time, because 8,500 seeds of the simulation ran beside it. Functions and worker grew in steps of about 1 MB.
The broker grew by 0.02 MB per minute, also after half an hour, so revocations are not its main cause. A broker alone
did not grow by 22,000 messages, and by 0.1 to 0.4 kB for each connection. Before the run of 99 minutes (2026-11-29,
counted after 50 minutes; 19,923 requests, 2,424 actions, no errors, no additional descriptors), each read of an audit
log kept the paths of all stored blobs, 0.85 kB each, and each closed connection of the broker waited for garbage
collection. Only a few short tests ran beside this run, in its first 20 minutes. Functions, worker and broker reach the
limit. The functions made two steps of 1.0 and 1.3 MB after 40 and 60 minutes, and did not grow after 70. The agent grew
in steps that became smaller: 1.0, 0.6, 0.8, 0.2 and 0.2 MB after 22, 53, 63, 76 and 87 minutes. In the run of
120 minutes (2026-11-29, counted after one hour; 23,753 requests, 2,910 actions, no errors; mutation testing with idle
priority ran beside its first 55 minutes), all programs but the broker reach the limit. The broker grew by 0.01 MB per
minute after 85 minutes, because its heap was fragmented: asyncio reads into blocks of 256 kB, which the GNU C library
takes from the heap, with small blocks behind them. With 25,000 messages a second and 30 new connections a second, the
heap grew by 1.4 MB in 2,400 connections, of which nothing was in use. The server's programs return large blocks since
then, and the same load does not increase the heap. In the last run (2026-11-30, 120 minutes, counted after one hour),
all programs reach the limit. The broker grew by 0.03 MB in the second hour. Tests with idle priority ran beside
the first 57 minutes.""",
)


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs the load for the requested hours, or for about a minute in a quick run, and evaluates it."""
    for_s = _QUICK_S if quick else 3600 * float(os.environ.get(HOURS, "1"))
    broker = cast("BrokerKind", os.environ.get(BROKER, "amqtt"))
    log(f"starting the laboratory with {broker}, then {for_s / 60:.1f} min of load")
    with (
        ended_by_signal() as ended,
        tempfile.TemporaryDirectory() as folder,
        start(Path(folder), broker, TELESCOPE_ROOM="lab", TELESCOPE_TRACE="") as product,
    ):
        with (
            ProcessWatcher(product.machine.process.pid, every_s=1.0 if quick else 5.0, file=SERIES) as watcher,
            Load(product, hold_s=4.0 if quick else 20.0) as clients,
        ):
            started_s, waited_us = time.monotonic(), processor_pressure_us()
            while (left_s := started_s + for_s - time.monotonic()) > 0 and not ended.wait(min(60.0, left_s)):
                log(progress(watcher.samples, clients))
            for_s = time.monotonic() - started_s
            waited = (processor_pressure_us() - waited_us) / 1e4 / for_s
        errors = clients.errors + log_errors(Path(folder) / "logs")
    warm_up_s = min(for_s * _WARM_UP, _MAX_WARM_UP_S)
    trends = after_warm_up(watcher.samples, warm_up_s, end_share=1 / 3 if quick else 0.1)
    report = Report(suite="soak", title="Soak", about=[_ABOUT.format(broker=broker)], quick=for_s < _FULL_S)
    report.tables = [_memory(trends, for_s), _descriptors(trends), _work(clients.done, errors, waited), _HISTORY]
    report.charts = charts(watcher.samples, warm_up_s)
    report.claims = _quick_claims(trends, errors) if quick else claims(trends, clients.done, errors, for_s)
    return report


@contextlib.contextmanager
def ended_by_signal() -> Iterator[threading.Event]:
    """Yields an event that SIGINT and SIGTERM set, so that an interrupted run also ends with its report."""
    ended = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(number, lambda *_: ended.set()) for number in numbers]
    try:
        yield ended
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)


def log_errors(folder: Path) -> Counter[str]:
    """Counts the error lines and tracebacks in the logs of the programs, by program and text."""
    found: Counter[str] = Counter()
    for path in sorted(folder.glob("*.log*")):
        found.update(f"{path.stem}: {line[:160]}" for line in _LOG_ERROR.findall(path.read_text(errors="replace")))
    return found


def processor_pressure_us() -> int:
    """Returns the total time in which this program, or one that it started, waited for a processor.

    Linux measures it for each control group (version 2); without groups it is that of the whole machine. It is 0 if
    Linux does not measure it.
    """
    groups = re.findall("^0::/(.*)$", Path("/proc/self/cgroup").read_text(), re.MULTILINE)
    roots = re.findall("^cgroup2 ([^ ]+) ", Path("/proc/mounts").read_text(), re.MULTILINE)
    own = (Path(root, group, _PRESSURE) for root in roots for group in groups)
    path = next(filter(Path.exists, own), Path("/proc/pressure/cpu"))
    return int(path.read_text().splitlines()[0].rpartition("total=")[2]) if path.exists() else 0


def progress(samples: list[Sample], clients: Load) -> str:
    """Returns one line with the memory of each part and the completed operations."""
    newest = {each.part: each for each in samples[-2 * len(PARTS) :]}
    usage = ", ".join(f"{part} {each.rss_mb:.0f} MB {each.descriptors} fd" for part, each in newest.items())
    errors = f"; ERRORS {dict(clients.errors)}" if clients.errors else ""
    return f"{usage}; {clients.done['HTTP requests']} requests, {clients.done['actions']} actions{errors}"


def claims(trends: list[DescriptorTrend], done: Counter[str], errors: Counter[str], for_s: float) -> list[Claim]:
    """Returns the targets of a full run."""
    (product,) = [each for each in trends if each.part == TOTAL]
    worst = max((each for each in trends if each is not product), key=lambda each: each.own.percent_per_h)
    length = f"{for_s / 60:.0f} min of load"
    return [
        Claim(f"own memory of the product, after warm-up, over {length}", product.own.percent_per_h, _MAX_SLOPE, "%/h"),
        Claim(
            f"own memory of the part with the fastest growth ({worst.part})", worst.own.percent_per_h, _MAX_SLOPE, "%/h"
        ),
        Claim(
            f"additional descriptors of any part after {length}",
            max(each.more_descriptors for each in trends),
            0,
            "descriptors",
        ),
        Claim(
            f"errors in {length}: {done['HTTP requests']:,} requests, {done['actions']:,} actions",
            sum(errors.values()),
            0,
            "errors",
        ),
    ]


def _quick_claims(trends: list[DescriptorTrend], errors: Counter[str]) -> list[Claim]:
    """Returns the targets of the last full run and those that a quick run can check."""
    latest = load("soak")
    found = []
    if latest is not None:
        found = [
            Claim(f"{each.text} (full run of {latest.created})", each.measured, each.bound, each.unit)
            for each in latest.claims
        ]
    return [
        *found,
        Claim(
            "additional descriptors of any part after a minute of load",
            max(each.more_descriptors for each in trends),
            0,
            "descriptors",
        ),
        Claim("errors in a minute of load", sum(errors.values()), 0, "errors"),
    ]


def _memory(trends: list[DescriptorTrend], for_s: float) -> Table:
    columns = ["part", "own MB", "own %/h", "95 %", "resident MB", "resident %/h", "95 %"]
    rows: list[list[str | float | int | None]] = [
        [
            each.part, each.own_mb, f"{each.own.percent_per_h:+.2f}",
            f"{each.own.low:+.2f} to {each.own.high:+.2f}", each.rss_mb, f"{each.rss.percent_per_h:+.2f}",
            f"{each.rss.low:+.2f} to {each.rss.high:+.2f}",
        ]
        for each in trends
    ]  # fmt: skip
    return Table(title=f"Memory over {for_s / 60:.0f} min", columns=columns, rows=rows, note=_NOTE)


def _descriptors(trends: list[DescriptorTrend]) -> Table:
    columns = ["part", "descriptors: first", "last", "max", "threads: first", "last"]
    rows: list[list[str | float | int | None]] = [
        [
            each.part,
            *map(int, (each.first_descriptors, each.last_descriptors, each.most_descriptors)),
            *map(int, (each.first_threads, each.last_threads)),
        ]
        for each in trends
    ]
    return Table(title="Descriptors and threads", columns=columns, rows=rows)


def _work(done: Counter[str], errors: Counter[str], waited_percent: float) -> Table:
    rows: list[list[str | float | int | None]] = [[name, count] for name, count in sorted(done.items())]
    rows += [[f"error: {name}", count] for name, count in sorted(errors.items())]
    rows.append(["share of the time in which the product or its load waited for a processor, %", waited_percent])
    return Table(title="Completed operations", columns=["operation", "count"], rows=rows)


def charts(samples: list[Sample], warm_up_s: float) -> list[Chart]:
    """Returns charts of memory over time, absolute and relative to the value after warm-up."""
    series: dict[str, list[float | None]] = {}
    change: dict[str, list[float | None]] = {}
    x: list[str | float] = []
    for part in PARTS:
        mine = [each for each in samples if each.part == part]
        if not mine:
            continue
        at_s, own_mb = reduced_to_medians([each.at_s for each in mine], [each.own_mb for each in mine])
        x = x or [round(each / 60, 2) for each in at_s]
        reference = next((value for at, value in zip(at_s, own_mb, strict=True) if at >= warm_up_s), own_mb[-1])
        # A part that started later or ended earlier has fewer samples.
        padded = [*own_mb[: len(x)], *[None] * (len(x) - len(own_mb))]
        series[part] = list(padded)
        change[part] = [None if value is None else round((value / reference - 1) * 100, 3) for value in padded]
    time_axis = "minutes of load"
    return [
        Chart(
            title="Own memory", kind="line", x_label=time_axis, y_label="MB (logarithmic)", x=x, series=series,
            log=True,
        ),
        Chart(
            title="Own memory relative to the end of warm-up", kind="line", x_label=time_axis, y_label="%", x=x,
            series={part: values for part, values in change.items() if part not in ("agent's children", "starter")},
        ),
    ]  # fmt: skip
