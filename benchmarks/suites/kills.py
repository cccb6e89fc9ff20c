"""Killed programs of a supervised product: lost, duplicated and false results of actions, and recovery."""

import os
from collections.abc import Callable
from typing import Final

from benchmarks.faults.kills import PROGRAMS, Kill, KillRuns, Verdict
from benchmarks.faults.launcher import PERSISTENCE
from benchmarks.reporting.report import Cell, Claim, Report, Table, percentile
from tests.harness.network.brokers import BROKERS, BrokerKind

COUNT: Final = "KILLS"
"""Environment variable that sets the number of kills of a full run."""
MAX_RECOVERY_S: Final = 10.0
_COUNT: Final = 500
_QUICK_COUNT: Final = 10
_ALL: Final = "any program"
_VARIANT_COUNT: Final = 40
_TLS: Final = {"TELESCOPE_TLS": "1"}
VARIANTS: Final[dict[str, tuple[BrokerKind, dict[str, str]]]] = {
    "amqtt": ("amqtt", {}),
    "mosquitto": ("mosquitto", {}),
    "amqtt, TLS": ("amqtt", _TLS),
    "mosquitto, TLS": ("mosquitto", _TLS),
    "mosquitto, persistence": ("mosquitto", {PERSISTENCE: "1"}),
}
"""Brokers, and variants with further settings, in which each program is killed less often."""
_ABOUT: Final = """The product runs as `make up` starts it, with one simulated UR5. A client starts one move after
another and retries a request with the same idempotency key until a response arrives. While an action runs, one program
is killed (SIGKILL) at a random time; all programs are killed equally often, in a random order. Its supervisor restarts
it. The supervisor takes all programs with it and is started again at once. `KILLS=50 python -m benchmarks kills` sets
another number."""
_NOTE: Final = """*Recovery*: time from the kill until two actions requested after it are done: the server waits for the
acks of one, the worker alone stores those of the other. Each takes about a second; a killed agent starts a new
simulation. The API is compared with the trace of the simulation, in which each action has its own target, and with the
starts that the agent reports. *Lost*: accepted, without a terminal status. *Duplicated*: started twice, or its target
reached twice. *False*: `done` without reaching the target, or another terminal status although the arm reached it,
unless the agent or its broker was killed at that time: the arm had not settled (0.2 s before), or the agent had not
recorded the result (1 s after)."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Kills programs over both brokers and their variants and evaluates the results."""
    count = (_QUICK_COUNT if quick else int(os.environ.get(COUNT, str(_COUNT)))) // len(BROKERS)
    kills: dict[str, list[Kill]] = {}
    verdicts: dict[str, Verdict] = {}
    for number, (name, (kind, settings)) in enumerate(VARIANTS.items()):
        if quick and settings:
            continue
        with KillRuns(kind, seed=number, settings=settings) as runs:
            runs.run(min(count, _VARIANT_COUNT) if settings else count, log)
            kills[name], verdicts[name] = runs.kills, runs.verdict()
        for false in verdicts[name].false:
            log(f"{name}: FALSE {false}")
    return report(kills, verdicts, quick=quick)


def report(kills: dict[str, list[Kill]], verdicts: dict[str, Verdict], *, quick: bool) -> Report:
    """Returns the tables and the targets."""
    result = Report(suite="kills", title="Killed programs", about=[_ABOUT], quick=quick)
    result.tables = [_recovery(kills), _results(verdicts)]
    result.claims = claims(kills, verdicts)
    return result


def claims(kills: dict[str, list[Kill]], verdicts: dict[str, Verdict]) -> list[Claim]:
    """Returns the targets."""
    name, slowest = max(
        ((name, each) for name, mine in kills.items() for each in mine), key=lambda each: each[1].recovery_s
    )
    count = sum(map(len, kills.values()))
    text = f"of {sum(each.accepted for each in verdicts.values()):,} actions during {count} kills"
    return [
        Claim(f"lost, {text}", sum(each.lost for each in verdicts.values()), 0, "actions"),
        Claim(f"duplicated, {text}", sum(each.duplicated for each in verdicts.values()), 0, "times"),
        Claim(f"false results, {text}", sum(len(each.false) for each in verdicts.values()), 0, "actions"),
        Claim(
            f"recovery after each of {count} kills, slowest: {slowest.program} ({name})",
            slowest.recovery_s,
            MAX_RECOVERY_S,
            "s",
        ),
    ]


def _recovery(kills: dict[str, list[Kill]]) -> Table:
    rows: list[list[Cell]] = []
    for program in (*PROGRAMS, _ALL):
        for name, mine in kills.items():
            times_s = [each.recovery_s for each in mine if program in (each.program, _ALL)]
            if times_s and (program == _ALL or name in BROKERS):
                rows.append([program, name, len(times_s), *(percentile(times_s, share) for share in (0.5, 0.95, 1.0))])
    columns = ["killed", "broker", "kills", "recovery s: p50", "p95", "max"]
    return Table(title="Recovery", columns=columns, rows=rows, note=_NOTE)


def _results(verdicts: dict[str, Verdict]) -> Table:
    rows: list[list[Cell]] = [
        [kind, each.accepted, each.lost, each.duplicated, len(each.false)] for kind, each in verdicts.items()
    ]
    return Table(title="Actions", columns=["broker", "accepted", "lost", "duplicated", "false"], rows=rows)
