"""Capacity of one machine: brokers, API, actions, robots per agent, memory, many agents, permissions."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks.reporting import cost_model
from benchmarks.reporting.report import Report
from benchmarks.scale import brokers, credentials, functions, load_tests, memory, robots

_ABOUT: Final = (
    """Capacity of one small machine and marginal costs. All programs, including the clients, share its cores."""
)
_BEFORE: Final = """**Before and after.** Route lookup took longer than reading a device: each router was searched
twice, pattern by pattern. Since then routes are filtered by prefix and depth. In the application without its server,
reading a device took 177 µs and then 134 µs, the list 240 and 190, `health`, the last route, 250 and 113; a bare
route takes 42 µs (2026-11-22, best of three)."""


def run(*, quick: bool, say: Callable[[str], None]) -> Report:
    """Runs all parts; all but the first use one product."""
    report = Report(suite="scale", title="Scale", quick=quick, about=[_ABOUT, _BEFORE])
    carried = brokers.measure(quick=quick, say=say)
    report.tables.append(brokers.table(carried))
    report.claims += brokers.claims(carried)
    say("starting the product")
    with tempfile.TemporaryDirectory() as folder, functions.started() as (stand, site):
        one, more = functions.measure(site, quick=quick, say=say)
        report.claims += functions.claims(one)
        report.tables.append(functions.table(one, more))
        report.charts.append(functions.chart(one, more))
        report.tables.append(memory.measure(site, quick=quick, say=say))
        crews = robots.measure(stand, quick=quick, say=say)
        report.tables.append(robots.table(crews))
        report.charts += [drawn] if (drawn := robots.chart(crews)) else []
        swarm = load_tests.LoadTest(stand, Path(folder))
        runs = []
        for count, rate_hz, gap_s in load_tests.QUICK if quick else load_tests.WHOLE:
            runs.append(swarm.run(count, rate_hz, gap_s, 5.0 if quick else 8.0))
            say(f"swarm of {count}: {runs[-1].figures['out_per_s']:.0f} messages/s, lost {runs[-1].lost}")
        report.tables.append(load_tests.table(runs))
        started = load_tests.actions(
            site, stand, Path(folder), seconds=3.0 if quick else 6.0, processes=functions.PROCESSES[:2]
        )
        report.tables.insert(2, functions.actions_table(started))
        say(f"actions: {started[0].answered.per_s:.0f}/s by one process, {started[1].answered.per_s:.0f}/s by two")
    steps = credentials.measure(credentials.QUICK if quick else credentials.WHOLE)
    report.tables.append(credentials.table(steps))
    if not quick:
        cost_model.keep({"runs": [run.kept() for run in runs], "credentials": {"steps": steps}})
    return report
