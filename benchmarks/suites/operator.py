"""Table 2 of the UR5 paper from an operator to a robot and back, over XMPP through the product."""

import contextlib
import statistics
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from benchmarks.baseline.interleaved import SHARES, measure_interleaved
from benchmarks.papers import operator
from benchmarks.papers.table2 import SAMPLES, SHOWN_RTT_MS, XMPP
from benchmarks.reporting.report import Cell, Claim, Report, Table, percentile
from tests.harness.cloud.cloud_processes import CloudProcesses
from tests.harness.network.delay import start_delay
from tests.harness.network.xmpp import start_xmpp_processes

_ABOUT: Final = """An operator with a lease sends a setpoint; the robot answers it with one telemetry message. Both are
behind the stated round trip to the server, where broker, Prosody, gateway and functions run. The paper's data passed
from a sender through Prosody to a receiver; here it also passes the gateway, which gives it to the broker with the
operator's own rights. Paths of one table run interleaved, so other load on the machine affects all of them."""
BOTH_XMPP: Final = "operator and robot over XMPP"
ROBOT_MQTT: Final = "operator over XMPP, robot over MQTT"
MQTT: Final = "operator and robot over MQTT"
PERIOD_S: Final = 3.0
"""Interval between messages of the paper [s]."""
ROUNDS: Final = 5
Durations = Mapping[str, tuple[list[float], list[float]]]
"""Path → times to the robot, and times until its answer [ms]."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs all round trips, and the paper's 20 messages with its interval."""
    report = Report(suite="operator", title="From operator to robot over XMPP", quick=quick, about=[_ABOUT])
    unlimited = {"TELESCOPE_RATE_ADDRESS": "0", "TELESCOPE_RATE_KEY": "0", "TELESCOPE_RATE_AGENT": "0"}
    with tempfile.TemporaryDirectory() as folder, start_xmpp_processes(Path(folder), unlimited) as processes:
        for rtt_ms, each in (
            {0: 20, SHOWN_RTT_MS: 6} if quick else {0: 100, 15: 40, SHOWN_RTT_MS: 30, 100: 12}
        ).items():
            found = with_round_trip(processes, rtt_ms, each=each)
            report.tables.append(all_samples(rtt_ms, found))
            log(f"{rtt_ms} ms: " + ", ".join(f"{name} {percentile(one[1], 0.5):.4g}" for name, one in found.items()))
        (to_robot_ms, back_ms) = with_round_trip(processes, SHOWN_RTT_MS, paced=True)[BOTH_XMPP]
    show(report, to_robot_ms, back_ms)
    return report


def with_round_trip(processes: CloudProcesses, rtt_ms: int, *, each: int = 1, paced: bool = False) -> Durations:
    """Measures all paths interleaved, or the path over XMPP alone with the paper's interval."""
    behind = (processes.broker.port, processes.endpoints["xmpp"].port)
    with contextlib.ExitStack() as stack:
        ports: Mapping[int, int] = {port: port for port in behind}
        if rtt_ms:
            ports = stack.enter_context(start_delay(*behind, rtt_ms=rtt_ms)).ports
        paths = {BOTH_XMPP: operator.over_xmpp(stack, ports, processes, robot_over_xmpp=True)}
        if not paced:
            paths[ROBOT_MQTT] = operator.over_xmpp(stack, ports, processes, robot_over_xmpp=False)
            paths[MQTT] = operator.over_mqtt(stack, ports, processes)
        exchanges = {name: path.exchange for name, path in paths.items()}
        if paced:
            back = measure_interleaved(exchanges, rounds=1, each=SAMPLES, warm_up=3, pause_s=PERIOD_S)
        else:
            back = measure_interleaved(exchanges, rounds=ROUNDS, each=each, warm_up=5)
        return {name: (path.to_robot_ms[-len(back[name]) :], back[name]) for name, path in paths.items()}


def show(report: Report, to_robot_ms: list[float], back_ms: list[float]) -> None:
    """Adds the table of 20 messages and the target."""
    rows: list[list[Cell]] = [
        [index + 1, XMPP[index], round(to_robot_ms[index], 1), round(back_ms[index], 1)] for index in range(SAMPLES)
    ]
    rows.append(["average", *(statistics.fmean(each) for each in (XMPP, to_robot_ms, back_ms))])
    note = (
        "The paper does not state the distance of its server, nor whether its value includes a way back. "
        f"One message every {PERIOD_S:g} s, as in the paper."
    )
    columns = ["sample", "published: XMPP", "operator to robot", "to the robot and back"]
    title = f"Table 2: 20 messages [ms], published and from operator to robot, {SHOWN_RTT_MS} ms round trip"
    report.tables.insert(0, Table(title=title, columns=columns, rows=rows, note=note))
    report.claims.append(
        Claim(
            f"Table 2 from operator to robot and back over XMPP at {SHOWN_RTT_MS} ms round trip, average",
            statistics.fmean(back_ms),
            round(statistics.fmean(XMPP), 2),
            "ms",
        )
    )


def all_samples(rtt_ms: int, found: Durations) -> Table:
    """Percentiles of each path, and the ratio of its median to that over MQTT."""
    rows: list[list[Cell]] = []
    for name, directions in found.items():
        for label, durations_ms, reference in zip(("to the robot", "and back"), directions, found[MQTT], strict=True):
            shares = [percentile(durations_ms, share) for share in SHARES.values()]
            rows.append([f"{name}, {label}", len(durations_ms), *shares, shares[0] / percentile(reference, 0.5)])
    return Table(
        title=f"From operator to robot, {rtt_ms} ms round trip{'' if rtt_ms else ' (loopback)'}",
        columns=["path", "n", *(f"{share} ms" for share in SHARES), "× MQTT"],
        rows=rows,
    )
