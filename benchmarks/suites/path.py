"""Duration of each part of a command and of a setpoint, measured on one clock."""

import json
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from benchmarks.baseline.product import HttpConnection, StreamingOperator
from benchmarks.reporting.report import Cell, Chart, Report, Table, percentile
from benchmarks.tracing.timestamps import Timestamp
from benchmarks.tracing.traced_product import TracedProduct, start
from tests.harness.network.brokers import BROKERS

ROBOT: Final = "ur5"
JOINT: Final = "wrist_3"
SWING_RAD: Final = 0.02
_WARM_UP: Final = 5
_WITHIN_S: Final = 10.0
REQUESTED: Final = "requested"
RESPONDED: Final = "responded"
Steps = tuple[tuple[str, str], ...]
"""(timestamp name, description of the part that ends there)."""
ACTION: Final[Steps] = (
    ("http-in", "HTTP request"),
    ("identified", "identity"),
    ("writing", "role, robot, lease, plan"),
    ("written", "row write"),
    ("publishing", "permission check, signature"),
    ("received:cmd", "publish, broker, to the agent"),
    ("checked", "agent: signature, journal, checks"),
    ("ack-published:started", "agent: start, journal"),
    ("ack-received:started", "ack: broker, to the functions"),
    ("http-out", "response's row"),
    (RESPONDED, "HTTP response to the caller"),
)
MOTION: Final[Steps] = (
    ("http-in", "HTTP request"),
    ("publishing", "functions: identity, role, row, signature"),
    ("received:cmd", "publish, broker, to the agent"),
    ("checked", "agent: signature, journal, checks"),
    ("driver", "control loop, driver"),
    ("moves:ur5", "simulation, to the first motion"),
)
SETPOINT: Final[Steps] = (
    ("received:ctl", "publish, broker, to the agent"),
    ("setpoint-accepted", "agent: decode, checks"),
    ("decided", "control loop: wait, decision"),
    ("driver", "driver applies the setpoint"),
    ("telemetry", "telemetry: measure, encode"),
    (RESPONDED, "broker, to the operator, decode"),
)
_ABOUT: Final = """Each program sends timestamps on the common clock of the machine's processes. A part is the time
between two consecutive timestamps, so the parts of one exchange add up to its duration. The product contains no
tracing: the benchmark wraps public functions, which costs about ten microseconds per timestamp. The operator holds a
simulated UR5; an action moves its wrist by one degree. All connections use loopback."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Measures both brokers."""
    report = Report(suite="path", title="Latency by stage", quick=quick, about=[_ABOUT])
    count = 28 if quick else 200
    found: dict[str, dict[str, Parts]] = {}
    for kind in BROKERS:
        log(f"{kind}: starting")
        with tempfile.TemporaryDirectory() as folder, start(Path(folder), kind, {ROBOT: JOINT}) as product:
            found[kind] = measure(product, count)
        log(", ".join(f"{path} {percentile(totals(each), 0.5):.3g} ms" for path, each in found[kind].items()))
    show(report, found)
    return report


Parts = list[dict[str, float]]
"""One dictionary per exchange: part → duration [ms]."""


def measure(product: TracedProduct, count: int) -> dict[str, Parts]:
    """Measures actions and setpoints alternately; incomplete exchanges are left out."""
    found: dict[str, Parts] = {"action": [], "first motion": [], "setpoint": []}
    with StreamingOperator(product, ROBOT) as operator, product.caller() as caller:
        home_rad = operator.target_rad[JOINT]
        for index in range(count + _WARM_UP):
            to_rad = home_rad + (0.0 if index % 2 else SWING_RAD)
            timestamps = list(_run_action(product, caller, operator, to_rad))
            stages: dict[str, dict[str, float] | None] = {}
            stages["action"], stages["first motion"] = parts(timestamps, ACTION), parts(timestamps, MOTION)
            operator.target_rad[JOINT] = to_rad
            operator.exchange()  # streaming resumes after the action
            time.sleep(0.1 + 0.003 * (index % 7))  # sample every phase of the control period
            stages["setpoint"] = parts(_send_setpoint(product, operator), SETPOINT)
            for name, one in stages.items():
                if one is not None and index >= _WARM_UP:
                    found[name].append(one)
    for name, each in found.items():
        if len(each) < count / 2:
            raise RuntimeError(
                f"{name}: only {len(each)} of {count} exchanges are complete; check the traced functions"
            )
    return found


def _run_action(
    product: TracedProduct, caller: HttpConnection, operator: StreamingOperator, to_rad: float
) -> Iterator[Timestamp]:
    """Runs one action and yields its timestamps."""
    request = {"kind": "move_joints", "position_rad": {JOINT: to_rad}}
    body = {"request": request, "epoch": operator.epoch, "wait_for": "started", "wait_ms": 10_000}
    payload = json.dumps(body).encode()
    product.timestamps.drain()
    product.timestamps.until(f"rests:{ROBOT}", since_ns=time.monotonic_ns(), within_s=_WITHIN_S)
    time.sleep(random.uniform(0.0, 0.01))  # sample every phase of the control period
    started_ns = time.monotonic_ns()
    yield Timestamp(REQUESTED, started_ns)
    started = caller.request("POST", f"/api/v1/devices/{operator.device['id']}/actions", payload)
    yield Timestamp(RESPONDED, time.monotonic_ns())
    yield from product.timestamps.until(f"moves:{ROBOT}", since_ns=started_ns, within_s=_WITHIN_S)
    caller.request("GET", f"/api/v1/actions/{started['id']}?wait_ms=10000")


def _send_setpoint(product: TracedProduct, operator: StreamingOperator) -> list[Timestamp]:
    """Sends one setpoint and returns its timestamps until telemetry reports it."""
    product.timestamps.drain()
    started_ns = time.monotonic_ns()
    duration_ms = operator.exchange()
    responded = Timestamp(RESPONDED, time.monotonic_ns())
    # `exchange` may have waited before it sent the setpoint.
    requested = Timestamp(REQUESTED, max(started_ns, responded.at_ns - round(duration_ms * 1e6)))
    return [requested, *product.timestamps.drain(), responded]


def parts(timestamps: Sequence[Timestamp], steps: Steps) -> dict[str, float] | None:
    """Returns the duration of each part [ms], or None if a timestamp is missing.

    The timestamp of a step is the first one of its name after the previous step.
    """
    timestamps = sorted(timestamps, key=lambda mark: mark.at_ns)
    at_ns = next(mark.at_ns for mark in timestamps if mark.name == REQUESTED)
    durations: dict[str, float] = {}
    for name, description in steps:
        following = next((mark.at_ns for mark in timestamps if mark.name == name and mark.at_ns >= at_ns), None)
        if following is None:
            return None
        durations[description] = (following - at_ns) / 1e6
        at_ns = following
    return durations


def totals(found: Parts) -> list[float]:
    """Returns the total duration of each exchange [ms]."""
    return [sum(each.values()) for each in found]


_TITLES: Final = {
    "action": "`POST actions` until started",
    "first motion": "`POST actions` until the simulated joint moves",
    "setpoint": "A setpoint until telemetry reports it",
}


def show(report: Report, found: dict[str, dict[str, Parts]]) -> None:
    """Adds a table per path and broker and a chart per path."""
    for path, title in _TITLES.items():
        for kind in found:
            report.tables.append(_table(f"{title}, over {kind}", found[kind][path]))
        names = list(next(iter(found.values()))[path][0])
        report.charts.append(
            Chart(
                title=title.replace("`", ""),
                kind="waterfall",
                x_label="ms, medians of the parts",
                y_label="",
                x=[*names],
                series={kind: [_median(each[path], name) for name in names] for kind, each in found.items()},
            )
        )


def _table(title: str, found: Parts) -> Table:
    total = percentile(totals(found), 0.5)
    rows: list[list[Cell]] = []
    for part in found[0]:
        median_ms = _median(found, part)
        rows.append(
            [part, median_ms, percentile([each[part] for each in found], 0.95), round(100 * median_ms / total, 1)]
        )
    summed = sum(_median(found, part) for part in found[0])
    rows += [
        ["sum of the medians", summed, None, round(100 * summed / total, 1)],
        ["total", total, percentile(totals(found), 0.95), 100.0],
    ]
    columns = ["part", "p50 ms", "p95 ms", "% of total"]
    return Table(title=f"{title}, n = {len(found)}", columns=columns, rows=rows)


def _median(found: Parts, part: str) -> float:
    return percentile([each[part] for each in found], 0.5)
