"""Tests mutants: ``python -m tests.harness.mutation [option …] [package …]``; ``--help`` lists the options.

Exits with 1 if a package's score is too low, a mutant survived that is not in ``survivors``, or the run was
interrupted.
"""

import argparse
import os
import random
import sys

from tests.harness.mutation import mutants, report
from tests.harness.paths import ROOT


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.harness.mutation")
    parser.add_argument("packages", nargs="*", metavar="package", help=", ".join(mutants.PACKAGES))
    parser.add_argument("--sample", type=int, help="number of mutants of each package; default: all")
    parser.add_argument("--seed", default="0", help="chooses the sample")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--page", action="store_true", help="write docs/results/mutation.md")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue the previous run: test only mutants of changed files, untested ones, and those that survived",
    )
    arguments = parser.parse_args()
    if arguments.page and arguments.packages:
        parser.error("--page needs the results of all packages")
    os.chdir(ROOT)
    names = mutants.generate(resume=arguments.resume)
    sample = {
        package: random.Random(arguments.seed).sample(
            names[package], min(arguments.sample or sys.maxsize, len(names[package]))
        )
        for package in arguments.packages or names
    }
    chosen = [name for each in sample.values() for name in each]
    previous = mutants.statuses()
    mutants.run([name for name in chosen if previous[name] not in report.DETECTED], arguments.workers)
    statuses = mutants.statuses()
    if any(statuses[name] in mutants.UNTESTED for name in chosen):
        print("interrupted; run the command again with --resume", file=sys.stderr)
        return 1
    listed = report.read_listed()
    scores = {
        package: report.score(mutants.results(package, chosen), listed, len(names[package]))
        for package, chosen in sample.items()
    }
    page = report.page(scores, listed)
    print(page)
    if arguments.page:
        (ROOT / "docs/results/mutation.md").write_text(page, encoding="utf-8")
    failures = report.failures(scores)
    print("\n".join(failures), file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
