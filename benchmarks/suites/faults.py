"""Faults during motion: time until rest, time until recovery, and lost actions."""

import math
from collections.abc import Callable, Iterable
from typing import Final

from benchmarks.faults.action_load import ActionLoad, duplicated, lost
from benchmarks.faults.fault_runs import FaultResult, FaultRuns
from benchmarks.faults.processes import start
from benchmarks.faults.stops import CALL, MESSAGE, SPEEDS, StopResult, StopRuns, series
from benchmarks.reporting.report import Cell, Chart, Claim, Report, Table, percentile
from device_agent.protocol.manifests import robot_type
from tests.harness.network.brokers import BROKERS
from tests.harness.paths import ROOT

_STOP_MOST_MS: Final = 10.0
_WATCHDOG_MOST_MS: Final = 350.0
_RECOVERY_MOST_S: Final = 10.0
_ROUNDS: Final = 2
_STOPS: Final = 20
_QUICK_STOPS: Final = 5
_RECORD: Final = "all orders, by the record"
_FULL_RAD_S: Final = 1.1
"""Maximum streaming speed of the arm."""
_RAMP_S: Final = 0.01
"""Time until braking reaches its full deceleration (``joint_motion.py``)."""
_WORDS: Final = dict(zip(SPEEDS, ("at rest", "at 0.1 rad/s", "at full speed of 1.1 rad/s"), strict=True))
_ABOUT: Final = """Two simulated UR5 share one agent. Operators, agent, functions, worker and broker are separate
processes; proxies between them inject the faults. An operator moves one arm back and forth at up to 1.1 rad/s. The
other arm receives one action after another over HTTP; a request keeps its idempotency key until a response arrives.
Each run injects a fault, repairs it and acquires control again."""
_FAULTS_NOTE: Final = """*Stop*: time from the last setpoint at the agent to the first line of the simulation's trace
(every 10 ms) without commanded motion. For a cut link or a killed broker, which the agent notices, it counts from the
cut; for killed functions, from the end of the lease; for a full disk, which ends the trace, by control periods. If
the fault alone does not stop the arm (delay, loss, clock, disk, reordered messages), the operator is killed or stops
streaming during the fault. A killed agent ends its simulation. *Recovery*: time from the repair (restart after a
kill, the cut itself otherwise) until a new lease moves one arm **and** the other arm completes a new action. It
includes 0.6 s in which the benchmark checks that nothing moves. *Lost*: accepted actions without a terminal state.
*Duplicated*: actions that started twice or that the trace shows twice, and setpoints applied after newer ones. The
full disk is a limit of 0 bytes on the growth of the agent's files."""
_STOP_NOTE: Final = """Time from just before the operator's publish or request to a control period ({period:g} ms), on
one clock and without proxies. *Braking*: the first period computed under the Stop. *Zero*: the first period without
commanded motion. The braking ramp between them follows from the arm's limits: at most {braking:g} rad/s², reached
within {ramp:g} ms. From 1.1 rad/s it takes at least {least:.0f} ms, so a Stop at full speed cannot reach zero within
10 ms."""

_TRIED: Final = Table(
    title="Stop, before and after",
    columns=["what was changed", "message → braking: p99 ms", "POST → braking: p99 ms"],
    rows=[
        ["before: a Stop waits for the next control period", 13.4, 15.5],
        ["a Stop starts a period at once; its message is published before signing", 6.62, 10.9],
        ["also directly after a period started by a setpoint", 1.99, 5.88],
    ],
    note="""Quick runs of one day (2026-11-22), 30 Stops per method. A period started by a Stop brakes for the time
since the previous period, so the arm never moves faster.""",
)


def run(*, quick: bool, say: Callable[[str], None]) -> Report:
    """Runs all faults on both brokers; a quick run divides the faults between the brokers."""
    found: list[FaultResult] = []
    stops: list[StopResult] = []
    orders: dict[tuple[str, str], tuple[int, int, int]] = {}
    for number, kind in enumerate(BROKERS):
        say(f"{kind}: starting")
        with start(kind) as ground:
            with ActionLoad(ground) as given:
                rounds = FaultRuns(ground, given, seed=number)
                chosen = rounds.names[number::2] if quick else rounds.names * _ROUNDS
                for fault in chosen:
                    found.append(rounds.round(fault))
                    say(_told(found[-1]))
            given.settle()
            again = rounds.wrist_went_back()
            rounds.close()
            for fault in {each.fault for each in given.given}:
                mine = [each for each in given.given if each.fault == fault]
                accepted = sum(bool(each.action) for each in mine)
                orders[kind, fault] = accepted, len(lost(mine)), len(duplicated(mine, ground.noted.begun))
            orders[kind, _RECORD] = 0, 0, again
            ground.restart_agent_without_proxies()
            with StopRuns(ground, seed=number) as made:
                stops += series(made, _QUICK_STOPS if quick else _STOPS, say)
    report = Report(suite="faults", title="Faults", about=[_ABOUT], quick=quick)
    report.tables = [faults_table(found, orders), stops_table(stops), _TRIED]
    report.charts = [_chart(stops)]
    report.claims = claims(found, stops, orders)
    return report


def _told(found: FaultResult) -> str:
    stop = "" if found.stop_ms is None else f"rest after {found.stop_ms:.0f} ms, "
    return f"{found.broker}: {found.fault}: {stop}recovered in {found.recovery_s:.1f} s"


Counted = dict[tuple[str, str], tuple[int, int, int]]
"""(broker, fault) → accepted, lost and duplicated actions."""


def faults_table(found: list[FaultResult], orders: Counted) -> Table:
    """Returns one row per fault and broker."""
    columns = ["fault", "broker", "rounds", "stop ms: most", "recovery s: most", "orders", "lost", "doubled"]
    rows: list[list[Cell]] = []
    for fault in dict.fromkeys(each.fault for each in found):
        for kind in BROKERS:
            mine = [each for each in found if (each.fault, each.broker) == (fault, kind)]
            if not mine:
                continue
            stop = max((each.stop_ms for each in mine if each.stop_ms is not None), default=None)
            accepted, gone, twice = orders.get((kind, fault), (0, 0, 0))
            recovery = max(each.recovery_s for each in mine)
            twice += sum(each.undone for each in mine)
            rows.append([fault, kind, len(mine), stop, recovery, accepted, gone, twice])
    records = [(kind, orders[kind, _RECORD]) for kind in BROKERS if (kind, _RECORD) in orders]
    rows += [[_RECORD, kind, None, None, None, None, None, again] for kind, (_, _, again) in records]
    return Table(title="What breaks", columns=columns, rows=rows, note=_FAULTS_NOTE)


def _select(stops: Iterable[StopResult], **wanted: str) -> list[StopResult]:
    return [each for each in stops if all(getattr(each, name) == value for name, value in wanted.items())]


def stops_table(stops: list[StopResult]) -> Table:
    """Returns one row per speed, method and broker."""
    columns = [
        "arm", "way", "broker", "n", "at rad/s", "braking ms: p50", "p99", "most", "zero ms: p50", "p99", "most"
    ]  # fmt: skip
    rows: list[list[Cell]] = []
    for speed in SPEEDS:
        for way in (MESSAGE, CALL):
            for kind in BROKERS:
                mine = _select(stops, speed=speed, way=way, broker=kind)
                if not mine:
                    continue
                row: list[Cell] = [speed, way, kind, len(mine), percentile([each.at_rad_s for each in mine], 0.5)]
                for taken in ([each.braking_ms for each in mine], [each.zero_ms for each in mine]):
                    row += [percentile(taken, share) for share in (0.5, 0.99, 1.0)]
                rows.append(row)
    return Table(title="Stop", columns=columns, rows=rows, note=_note())


def _note() -> str:
    """Returns the note with the arm's limits: a trapezoidal deceleration takes the plateau and one ramp."""
    arm = robot_type.load(ROOT / "robots" / "ur5")
    least_s = _FULL_RAD_S / arm.braking_rad_s2 + _RAMP_S
    return _STOP_NOTE.format(
        period=arm.period_ms, braking=arm.braking_rad_s2, ramp=_RAMP_S * 1000, least=least_s * 1000
    )


def _chart(stops: list[StopResult]) -> Chart:
    series: dict[str, list[float | None]] = {"braking begins, all": [each.braking_ms for each in stops]}
    for speed in SPEEDS:
        series[f"zero, {speed}"] = [each.zero_ms for each in _select(stops, speed=speed)]
    return Chart(
        title="From Stop to braking, and to zero commanded velocity", kind="cdf", x_label="ms",
        y_label="share of StopRuns", x=[], series=series,
    )  # fmt: skip


def claims(found: list[FaultResult], stops: list[StopResult], orders: Counted) -> list[Claim]:
    """Returns the targets."""
    made: list[Claim] = []
    for way in (MESSAGE, CALL):
        mine = _select(stops, way=way)
        braking = percentile([each.braking_ms for each in mine], 0.99)
        text = f"Stop by {way} → braking begins, p99 of {len(mine)}"
        made.append(Claim(text, braking, _STOP_MOST_MS, "ms"))
    for speed in SPEEDS:
        zero = [each.zero_ms for each in _select(stops, way=MESSAGE, speed=speed)]
        text = f"Stop by {MESSAGE} → zero commanded velocity, arm {_WORDS[speed]}, p99 of {len(zero)}"
        made.append(Claim(text, percentile(zero, 0.99), _STOP_MOST_MS, "ms"))
    rest = [math.inf if each.moved_again else each.stop_ms for each in found if each.stop_ms is not None]
    slowest = max(found, key=lambda each: each.recovery_s)
    accepted = sum(each[0] for each in orders.values())
    undone = sum(each.undone for each in found)
    return [
        *made,
        Claim(
            f"last fresh setpoint → zero commanded velocity, and rest until a new lease, most of {len(rest)}",
            max(rest),
            _WATCHDOG_MOST_MS,
            "ms",
        ),
        Claim(
            f"recovery after each fault, slowest: {slowest.fault} over {slowest.broker}",
            slowest.recovery_s,
            _RECOVERY_MOST_S,
            "s",
        ),
        Claim(f"lost, of {accepted} orders", sum(each[1] for each in orders.values()), 0, "orders"),
        Claim(
            "duplicated: actions executed twice, setpoints applied after newer ones",
            sum(each[2] for each in orders.values()) + undone,
            0,
            "times",
        ),
    ]
