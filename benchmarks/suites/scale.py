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
_HISTORY: Final = """**Effect of a change.** Route lookup took longer than reading a device: each router was searched
twice, pattern by pattern. Since then routes are filtered by prefix and depth. In the application without its server,
reading a device took 177 µs and then 134 µs, the list 240 and 190, `health`, the last route, 250 and 113; a bare
route takes 42 µs (2026-11-22, best of three)."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs all parts; all but the first use one product."""
    report = Report(suite="scale", title="Scale", quick=quick, about=[_ABOUT, _HISTORY])
    broker_runs = brokers.measure(quick=quick, log=log)
    report.tables.append(brokers.table(broker_runs))
    report.claims += brokers.claims(broker_runs)
    log("starting the product")
    with tempfile.TemporaryDirectory() as folder, functions.started() as (product, site):
        one, more = functions.measure(site, quick=quick, log=log)
        report.claims += functions.claims(one)
        report.tables.append(functions.table(one, more))
        report.charts.append(functions.chart(one, more))
        report.tables.append(memory.measure(site, quick=quick, log=log))
        agents = robots.measure(product, quick=quick, log=log)
        report.tables.append(robots.table(agents))
        report.charts += [chart] if (chart := robots.chart(agents)) else []
        load_test = load_tests.LoadTest(product, Path(folder))
        runs = []
        for count, rate_hz, gap_s in load_tests.QUICK if quick else load_tests.FULL:
            runs.append(load_test.run(count, rate_hz, gap_s, 5.0 if quick else 8.0))
            log(f"{count} load-test agents: {runs[-1].figures['out_per_s']:.0f} messages/s, lost {runs[-1].lost}")
        report.tables.append(load_tests.table(runs))
        started = load_tests.actions(
            site, product, Path(folder), seconds=3.0 if quick else 6.0, processes=functions.PROCESSES[:2]
        )
        report.tables.insert(2, functions.actions_table(started))
        log(f"actions: {started[0].result.per_s:.0f}/s by one process, {started[1].result.per_s:.0f}/s by two")
    steps = credentials.measure(credentials.QUICK if quick else credentials.FULL)
    report.tables.append(credentials.table(steps))
    if not quick:
        cost_model.save({"runs": [run.cost_model_values() for run in runs], "credentials": {"steps": steps}})
    return report
