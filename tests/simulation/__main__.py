"""Command line of the simulation: ``python -m tests.simulation --help``."""

import argparse
import sys
import time

from tests.simulation import planted, runs
from tests.simulation.plan import create

PROGRESS = 500
"""Seeds between two lines of progress."""


def main() -> int:
    """Run simulations. Returns 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seed", type=int, help="replay this seed, with a trace")
    parser.add_argument("--steps", help="with --seed: only these steps of its plan, for example 3,5,7")
    parser.add_argument("--shrink", action="store_true", help="with --seed: print a minimal plan instead of the trace")
    parser.add_argument(
        "--seeds", type=int, default=100, metavar="N", help="without --seed: run N seeds (default: 100)"
    )
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="first of the N seeds (default: 0)")
    parser.add_argument("--planted", choices=sorted(planted.DEFECTS), help="run with this defect in the product")
    options = parser.parse_args()
    defect = options.planted or ""
    if options.seed is None:
        return _search(options.first, options.seeds, defect)
    if options.shrink:
        print(runs.report(options.seed, defect=defect))
        return 0
    plan = create(options.seed)
    if options.steps is not None:
        numbers = {int(number) for number in options.steps.split(",") if number}
        plan = [step for step in plan if step.number in numbers]
    history = runs.run(options.seed, plan, defect=defect)
    print("\n".join(["plan", *map(str, plan), "history", *history.text(), f"digest {history.digest}"]))
    return 1 if history.violations else 0


def _search(first: int, count: int, defect: str) -> int:
    """Run seeds; report the first failure with its minimal plan, and stop there if a defect is planted."""
    started_s = time.monotonic()
    failed = 0
    outcomes = runs.run_seeds(range(first, first + count), defect=defect)
    for number, outcome in enumerate(outcomes, 1):
        if outcome.violations:
            failed += 1
            kinds = ", ".join(sorted({violation.kind for violation in outcome.violations}))
            print(f"seed {outcome.seed}: {kinds}", flush=True)
            if failed == 1:
                print(runs.report(outcome.seed, defect=defect), flush=True)
            if defect:
                print(f"found with seed {outcome.seed}, the {number}. of {count}")
                outcomes.close()
                return 1
        if number % PROGRESS == 0:
            rate = number / (time.monotonic() - started_s)
            print(f"{number} of {count} seeds, {failed} failed, {rate:.1f} seeds per second", flush=True)
    elapsed_s = time.monotonic() - started_s
    print(f"{count} seeds, {failed} failed, {count / elapsed_s:.1f} seeds per second")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
