"""One hour of load on the laboratory: memory, descriptors and errors."""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks.baseline.product import start
from benchmarks.reporting.report import QUICK, Chart, Claim, Report, Table, load
from benchmarks.soak.load import Load
from benchmarks.soak.processes import PARTS, TOTAL, ProcessWatcher, Sample
from benchmarks.soak.trends import DescriptorTrend, after_warm_up, reduced_to_medians

MINUTES: Final = "SOAK_MINUTES"
"""Environment variable that sets the duration of the full run [min]."""
SERIES: Final = QUICK / "soak.csv"
"""File of all samples; it remains after a killed run."""
_MAX_SLOPE: Final = 1.0
_QUICK_S: Final = 48.0
_WARM_UP: Final = 1 / 3
"""Warm-up share of the run, after which caches and pools are full (17 to 20 minutes of an hour)."""
_ABOUT: Final = """The laboratory as `make up` starts it with amqtt: four robots and a room behind one agent. One
client streams setpoints to the arm and acquires, renews and releases leases, each time with new credentials. Movement
scripts run on all robots; one robot is stopped during every third movement and reset. Two clients subscribe to all
telemetry and reconnect with new credentials. One client signs in, reads resources and signs out. `SOAK_MINUTES=10
python -m benchmarks soak` sets another duration; each sample is written to `benchmarks/results/quick/soak.csv`."""
_NOTE: Final = """Theil-Sen slopes over medians of one minute, after a warm-up of one third of the run, with Sen's 95
% interval; a plus sign means growth. Own memory is anonymous memory (heap and stack); resident memory includes shared
libraries. First and last descriptors and threads are the lowest tenth of the first and the last tenth of the run
after warm-up, because each running script has its own. The agent's children are its planner and script sandboxes;
their number follows the load."""

_HISTORY: Final = Table(
    title="Memory: effect of changes",
    columns=["change", "minutes", "functions %/h", "worker", "broker", "agent", "total"],
    rows=[
        ["before", 60, 6.9, 0.9, 1.6, 3.3, 3.6],
        ["agents delete confirmed messages; the load reads a constant amount", 34, 9.4, 0.6, 1.1, 0.6, 2.3],
        ["the garbage collector runs as often as by default", 60, 1.5, 2.1, 1.1, 0.5, 1.0],
    ],
    note="""Own memory from the fifteenth minute, one run each (2026-11-22). Agents kept QoS 1 messages that were
confirmed early; the load requested all stored data, so responses grew; the garbage collector of the functions ran as
rarely as during import, so garbage accumulated for ten minutes and more. The broker grows by revocations of about 300
bytes each, which it keeps for the lifetime of a token, one hour.""",
)


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs the load for an hour, or for about a minute in a quick run, and evaluates it."""
    for_s = _QUICK_S if quick else 60 * float(os.environ.get(MINUTES, "60"))
    log(f"starting the laboratory, then {for_s / 60:.1f} min of load")
    with (
        tempfile.TemporaryDirectory() as folder,
        start(Path(folder), "amqtt", TELESCOPE_ROOM="lab", TELESCOPE_TRACE="") as product,
        ProcessWatcher(product.machine.process.pid, every_s=1.0 if quick else 5.0, file=SERIES) as watcher,
        Load(product, hold_s=4.0 if quick else 20.0) as clients,
    ):
        started_s = time.monotonic()
        logged_s = started_s
        while (now_s := time.monotonic()) < started_s + for_s:
            time.sleep(min(1.0, started_s + for_s - now_s))
            if now_s > logged_s + 60:
                logged_s = now_s
                log(progress(watcher.samples, clients))
    trends = after_warm_up(watcher.samples, for_s * _WARM_UP, end_share=1 / 3 if quick else 0.1)
    report = Report(suite="soak", title="Soak", about=[_ABOUT], quick=quick)
    report.tables = [_memory(trends, for_s), _descriptors(trends), _work(clients), _HISTORY]
    report.charts = charts(watcher.samples, for_s * _WARM_UP)
    report.claims = _quick_claims(trends, clients) if quick else claims(trends, clients, for_s)
    return report


def progress(samples: list[Sample], clients: Load) -> str:
    """Returns one line with the memory of each part and the completed operations."""
    newest = {each.part: each for each in samples[-2 * len(PARTS) :]}
    usage = ", ".join(f"{part} {each.rss_mb:.0f} MB {each.descriptors} fd" for part, each in newest.items())
    errors = f"; ERRORS {dict(clients.errors)}" if clients.errors else ""
    return f"{usage}; {clients.done['HTTP requests']} requests, {clients.done['actions']} actions{errors}"


def claims(trends: list[DescriptorTrend], clients: Load, for_s: float) -> list[Claim]:
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
            f"errors in {length}: {clients.done['HTTP requests']:,} requests, {clients.done['actions']:,} actions",
            sum(clients.errors.values()),
            0,
            "errors",
        ),
    ]


def _quick_claims(trends: list[DescriptorTrend], clients: Load) -> list[Claim]:
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
        Claim("errors in a minute of load", sum(clients.errors.values()), 0, "errors"),
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


def _work(clients: Load) -> Table:
    rows: list[list[str | float | int | None]] = [[name, count] for name, count in sorted(clients.done.items())]
    rows += [[f"error: {name}", count] for name, count in sorted(clients.errors.items())]
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
