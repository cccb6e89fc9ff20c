"""Runs benchmark suites, writes ``results/*.json`` and ``docs/results/benchmarks.md``.

Usage: ``python -m benchmarks [SUITE …] [--quick]``. Prints each target with the measured value. The exit code is 1 if a
target is missed. A quick run writes to ``results/quick`` only; the page shows full runs.
"""

import argparse
import importlib
import sys
import time
from typing import Any

from benchmarks import suites
from benchmarks.reporting import page
from benchmarks.reporting.report import QUICK, RESULTS, Report, save


def main() -> int:
    """Runs the requested suites in order and returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=f"one of {', '.join(suites.NAMES)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="take fewer samples: all suites in about ten minutes")
    chosen = parser.parse_args()
    unknown = sorted(set(chosen.suites) - set(suites.NAMES))
    if unknown:
        parser.error(f"unknown suite {', '.join(unknown)}; choose from {', '.join(suites.NAMES)}")
    try:
        reports = [run(name, quick=chosen.quick) for name in chosen.suites or suites.NAMES]
    except KeyboardInterrupt:
        print("\ninterrupted: the suite that was running has no report; complete suites are saved", file=sys.stderr)
        return 130
    if not chosen.quick:
        page.write()
    claims = [claim for report in reports for claim in report.claims]
    print()
    for claim in claims:
        print("reached    " if claim.holds else "NOT REACHED", claim.line())
    return 0 if all(claim.holds for claim in claims) else 1


def run(name: str, *, quick: bool) -> Report:
    """Runs one suite and saves its report."""
    started_s = time.monotonic()
    suite: Any = importlib.import_module(f"benchmarks.suites.{name}")

    def log(line: str) -> None:
        print(f"{name:10} {time.monotonic() - started_s:6.0f} s  {line}", flush=True)

    report: Report = suite.run(quick=quick, log=log)
    save(report, QUICK if report.quick else RESULTS)
    log(f"done, {sum(claim.holds for claim in report.claims)} of {len(report.claims)} claims hold")
    return report


if __name__ == "__main__":
    sys.exit(main())
