"""Faults during motion: time until rest, time until recovery, and lost actions."""

import math
import os
import re
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from benchmarks.faults.action_load import ActionLoad, duplicated, lost
from benchmarks.faults.fault_runs import FaultResult, FaultRuns
from benchmarks.faults.processes import ACTION_ARM, ProductProcesses, start
from benchmarks.faults.stops import CALL, MESSAGE, SPEEDS, StopResult, StopRuns, series
from benchmarks.reporting.report import Cell, Chart, Claim, Report, Table, percentile
from device_agent.protocol.manifests import robot_type
from tests.harness.network.brokers import BROKERS
from tests.harness.paths import ROOT

_MAX_STOP_MS: Final = 10.0
_MAX_WATCHDOG_MS: Final = 350.0
_MAX_RECOVERY_S: Final = 10.0
NAMES: Final = "FAULTS"
ROUNDS: Final = "FAULT_ROUNDS"
"""Environment variables that select faults (a regular expression) and set the number of rounds of each."""
LEAST_ROUNDS: Final = 30
"""Rounds of each published row."""
_STOPS: Final = 20
_QUICK_STOPS: Final = 5
_TRACE: Final = "all actions, from the trace"
_FULL_RAD_S: Final = 1.1
"""Maximum streaming speed of the arm."""
_RAMP_S: Final = 0.01
"""Time until braking reaches its full deceleration (``joint_motion.py``)."""
_SPEED_TEXTS: Final = dict(zip(SPEEDS, ("at rest", "at 0.1 rad/s", "at full speed of 1.1 rad/s"), strict=True))
_ABOUT: Final = """Two simulated UR5 share one agent. Operators, agent, functions, worker and broker are separate
processes; proxies between them inject the faults. An operator moves one arm back and forth at up to 1.1 rad/s. The
other arm receives one action after another over HTTP; a request keeps its idempotency key until a response arrives.
Each run injects a fault, repairs it and acquires control again."""
_FAULTS_NOTE: Final = """*Stop*: time from the last setpoint at the agent to the first line of the simulation's trace
(every 10 ms) without commanded motion. For a cut link or a killed broker, which the agent detects, it counts from the
cut; for killed functions, from the end of the lease; for a full disk, which ends the trace, by control periods. If
the fault alone does not stop the arm (delay, loss, clock, disk, memory, descriptors, reordered messages), the
operator is killed or stops streaming during the fault. The agent refuses setpoints that are as old as over a round
trip of 300 ms, so the arm rests; the time counts from the last applied one. A killed agent ends its simulation.
*Recovery*: time from the repair (restart after a kill, the cut itself otherwise) until a new lease moves one arm
**and** the other arm completes a new action. It includes 0.6 s in which the benchmark checks that nothing moves.
*Lost*: accepted actions without a terminal state. *Duplicated*: actions that started twice or that the trace shows
twice, and setpoints applied after newer ones. *False*: results that differ from the trace, and lists with missing or
repeated rows. A full disk is a limit of 0 bytes on the growth of files. Memory and descriptors are limited to the
present use. The server's clock is that of functions, worker and broker; SQLite rejects writes to read-only tables.
With 2,000 devices, two clients read the list of all devices and the 10⁴ actions of one arm all the time."""
_STOP_NOTE: Final = """Time from just before the operator's publish or request to a control period ({period:g} ms), on
one clock and without proxies. *Braking*: the first period computed under the Stop. *Zero*: the first period without
commanded motion. The braking ramp between them follows from the arm's limits: at most {braking:g} rad/s², reached
within {ramp:g} ms. From 1.1 rad/s it takes at least {minimum:.0f} ms, so a Stop at full speed cannot reach zero within
10 ms."""

_HISTORY: Final = Table(
    title="Stop: effect of changes",
    columns=["change", "message → braking: p99 ms", "POST → braking: p99 ms"],
    rows=[
        ["before: a Stop waits for the next control period", 13.4, 15.5],
        ["a Stop starts a period immediately; its message is published before signing", 6.62, 10.9],
        ["also directly after a period started by a setpoint", 1.99, 5.88],
    ],
    note="""Quick runs of one day (2026-11-22), 30 Stops per method. A period started by a Stop brakes for the time
since the previous period, so the arm never moves faster.""",
)


class Counts(NamedTuple):
    """Numbers of actions during one fault over one broker, or of all actions in the trace."""

    accepted: int = 0
    lost: int = 0
    duplicated: int = 0
    false: int = 0


CountTable = dict[tuple[str, str], Counts]
"""(broker, fault) → numbers."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs all faults on both brokers; a quick run divides the faults between the brokers."""
    pattern, rounds = re.compile(os.environ.get(NAMES, "")), int(os.environ.get(ROUNDS, str(LEAST_ROUNDS)))
    results: list[FaultResult] = []
    stops: list[StopResult] = []
    counts: CountTable = {}
    for number, kind in enumerate(BROKERS):
        log(f"{kind}: starting")
        with start(kind) as product:
            found, numbers = run_faults(product, number, pattern, 0 if quick else rounds, log)
            results += found
            counts |= numbers
            product.restart_agent_without_proxies()
            with StopRuns(product, seed=number) as stop_runs:
                stops += series(stop_runs, _QUICK_STOPS if quick else _STOPS, log)
    return report(results, counts, stops, quick=quick)


def run_faults(
    product: ProductProcesses, number: int, pattern: re.Pattern[str], rounds: int, log: Callable[[str], None]
) -> tuple[list[FaultResult], CountTable]:
    """Runs each fault whose name has the pattern a number of times; 0: every second fault once."""
    results: list[FaultResult] = []
    counts: CountTable = {}
    with ActionLoad(product.api, product.token, product.device(ACTION_ARM)) as load:
        runs = FaultRuns(product, load, seed=number)
        names = [name for name in runs.names if pattern.search(name)]
        for name in [each for each in names for _ in range(rounds)] if rounds else names[number::2]:
            results.append(runs.round(name))
            log(_line(results[-1]))
        load.stop()
        load.settle()
    repeated, false = runs.compare_actions()
    runs.close()
    for problem in (*false, *runs.crowd.problems):
        log(f"{product.kind}: FALSE {problem}")
    for fault in {each.fault for each in load.actions}:
        mine = [each for each in load.actions if each.fault == fault]
        accepted = sum(bool(each.id) for each in mine)
        counts[product.kind, fault] = Counts(accepted, len(lost(mine)), len(duplicated(mine, product.recorder.starts)))
    counts[product.kind, _TRACE] = Counts(duplicated=repeated, false=len(false) + len(runs.crowd.problems))
    return results, counts


def report(results: list[FaultResult], counts: CountTable, stops: list[StopResult], *, quick: bool) -> Report:
    """Returns tables, charts and targets."""
    made = Report(suite="faults", title="Faults", about=[_ABOUT], quick=quick)
    made.tables = [
        faults_table(results, counts, least_rounds=0 if quick else LEAST_ROUNDS),
        stops_table(stops),
        _HISTORY,
    ]
    made.charts = [_chart(stops)]
    made.claims = claims(results, stops, counts)
    return made


def _line(result: FaultResult) -> str:
    stop = "" if result.stop_ms is None else f"rest after {result.stop_ms:.0f} ms, "
    return f"{result.broker}: {result.fault}: {stop}recovered in {result.recovery_s:.1f} s"


def faults_table(results: list[FaultResult], counts: CountTable, *, least_rounds: int = 0) -> Table:
    """Returns one row per fault and broker with this number of rounds."""
    columns = [
        "fault",
        "broker",
        "rounds",
        "stop ms: max",
        "recovery s: p50",
        "max",
        "actions",
        "lost",
        "duplicated",
        "false",
    ]
    rows: list[list[Cell]] = []
    for fault in dict.fromkeys(each.fault for each in results):
        for kind in BROKERS:
            mine = [each for each in results if (each.fault, each.broker) == (fault, kind)]
            if not mine or len(mine) < least_rounds:
                continue
            stop = max((each.stop_ms for each in mine if each.stop_ms is not None), default=None)
            numbers = counts.get((kind, fault), Counts())
            recovery_s = [each.recovery_s for each in mine]
            duplicates = numbers.duplicated + sum(each.reordered for each in mine)
            times: list[Cell] = [stop, percentile(recovery_s, 0.5), max(recovery_s)]
            rows.append([fault, kind, len(mine), *times, numbers.accepted, numbers.lost, duplicates, None])
    for kind in BROKERS:
        if (kind, _TRACE) in counts:
            numbers = counts[kind, _TRACE]
            rows.append([_TRACE, kind, *[None] * 6, numbers.duplicated, numbers.false])
    return Table(title="Faults and recovery", columns=columns, rows=rows, note=_FAULTS_NOTE)


def _select(stops: Iterable[StopResult], **values: str) -> list[StopResult]:
    return [each for each in stops if all(getattr(each, name) == value for name, value in values.items())]


def stops_table(stops: list[StopResult]) -> Table:
    """Returns one row per speed, method and broker."""
    columns = [
        "arm", "method", "broker", "n", "at rad/s", "braking ms: p50", "p99", "max", "zero ms: p50", "p99", "max"
    ]  # fmt: skip
    rows: list[list[Cell]] = []
    for speed in SPEEDS:
        for method in (MESSAGE, CALL):
            for kind in BROKERS:
                mine = _select(stops, speed=speed, method=method, broker=kind)
                if not mine:
                    continue
                row: list[Cell] = [speed, method, kind, len(mine), percentile([each.at_rad_s for each in mine], 0.5)]
                for samples in ([each.braking_ms for each in mine], [each.zero_ms for each in mine]):
                    row += [percentile(samples, share) for share in (0.5, 0.99, 1.0)]
                rows.append(row)
    return Table(title="Stop", columns=columns, rows=rows, note=_note())


def _note() -> str:
    """Returns the note with the arm's limits: a trapezoidal deceleration takes the plateau and one ramp."""
    arm = robot_type.load(ROOT / "robots" / "ur5")
    minimum_s = _FULL_RAD_S / arm.braking_rad_s2 + _RAMP_S
    return _STOP_NOTE.format(
        period=arm.period_ms, braking=arm.braking_rad_s2, ramp=_RAMP_S * 1000, minimum=minimum_s * 1000
    )


def _chart(stops: list[StopResult]) -> Chart:
    series: dict[str, list[float | None]] = {"braking begins, all": [each.braking_ms for each in stops]}
    for speed in SPEEDS:
        series[f"zero, {speed}"] = [each.zero_ms for each in _select(stops, speed=speed)]
    return Chart(
        title="From Stop to braking, and to zero commanded velocity", kind="cdf", x_label="ms",
        y_label="share of Stops", x=[], series=series,
    )  # fmt: skip


def claims(results: list[FaultResult], stops: list[StopResult], counts: CountTable) -> list[Claim]:
    """Returns the targets."""
    stop_claims: list[Claim] = []
    for method in (MESSAGE, CALL):
        mine = _select(stops, method=method)
        braking = percentile([each.braking_ms for each in mine], 0.99)
        text = f"Stop by {method} → braking begins, p99 of {len(mine)}"
        stop_claims.append(Claim(text, braking, _MAX_STOP_MS, "ms"))
    for speed in SPEEDS:
        zero = [each.zero_ms for each in _select(stops, method=MESSAGE, speed=speed)]
        text = f"Stop by {MESSAGE} → zero commanded velocity, arm {_SPEED_TEXTS[speed]}, p99 of {len(zero)}"
        stop_claims.append(Claim(text, percentile(zero, 0.99), _MAX_STOP_MS, "ms"))
    rest = [math.inf if each.moved_again else each.stop_ms for each in results if each.stop_ms is not None]
    slowest = max(results, key=lambda each: each.recovery_s)
    accepted = sum(each.accepted for each in counts.values())
    reordered = sum(each.reordered for each in results)
    return [
        *stop_claims,
        Claim(
            f"last fresh setpoint → zero commanded velocity, and rest until a new lease, max of {len(rest)}",
            max(rest),
            _MAX_WATCHDOG_MS,
            "ms",
        ),
        Claim(
            f"recovery after each fault, slowest: {slowest.fault} over {slowest.broker}",
            slowest.recovery_s,
            _MAX_RECOVERY_S,
            "s",
        ),
        Claim(f"lost, of {accepted} actions", sum(each.lost for each in counts.values()), 0, "actions"),
        Claim(
            "duplicated: actions executed twice, setpoints applied after newer ones",
            sum(each.duplicated for each in counts.values()) + reordered,
            0,
            "times",
        ),
        Claim("results that differ from the trace", sum(each.false for each in counts.values()), 0, "actions"),
    ]
