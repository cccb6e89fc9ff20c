"""Deterministic simulation of cloud, broker, network and agents: the promises hold with every seed."""

import os
import subprocess
import sys

import pytest

from tests.harness.paths import ROOT
from tests.simulation import planted, runs
from tests.simulation.plan import FAULTS, OPERATIONS, create
from tests.simulation.shrink import shrink

SEEDS = 100
ALL_SEEDS = 10_000
MOST_SEEDS = 1_000
"""Seeds within which each planted defect must be found."""
FOUND_WITH = {
    "duplicates-run-again": 32,
    "burned-epoch-accepted": 609,
    "slot-without-etag": 9,
    "latch-not-persisted": 5,
    "epoch-not-persisted": 5,
    "ttl-ignored": 24,
    "no-watchdog": 42,
    "renewed-after-expiry": 14,
    "lease-taken-while-held": 11,
    "stop-confirmed-early": 5,
}
"""Defect → a seed that finds it. `make test` runs this seed only."""
CHAOTIC = 41
"""A seed whose plan has many steps and faults."""


def test_equal_seeds_give_equal_histories() -> None:
    first, second = runs.run(CHAOTIC), runs.run(CHAOTIC)
    assert first.text() == second.text()
    assert first.digest != runs.run(CHAOTIC + 1).digest


def test_the_history_does_not_depend_on_the_process() -> None:
    digests = {
        subprocess.run(
            [sys.executable, "-m", "tests.simulation", "--seed", str(CHAOTIC)],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=False,
        ).stdout.splitlines()[-1]
        for seed in ("1", "2")
    }
    assert digests == {f"digest {runs.run(CHAOTIC).digest}"}


@pytest.mark.timeout(600)
def test_the_promises_hold_with_a_hundred_seeds() -> None:
    _require_no_violation(range(SEEDS))


@pytest.mark.long
@pytest.mark.timeout(6 * 3600)
def test_the_promises_hold_with_ten_thousand_seeds() -> None:
    _require_no_violation(range(SEEDS, SEEDS + ALL_SEEDS))


@pytest.mark.parametrize("defect", sorted(planted.DEFECTS))
def test_a_planted_defect_is_found(defect: str) -> None:
    find = f"python -m tests.simulation --planted {defect} --seeds {MOST_SEEDS}"
    assert FOUND_WITH[defect] < MOST_SEEDS
    assert runs.run(FOUND_WITH[defect], defect=defect).violations, f"its plan has changed; find another: `{find}`"


def test_a_failure_is_reported_with_a_minimal_plan() -> None:
    seed = FOUND_WITH["lease-taken-while-held"]
    report = runs.report(seed, defect="lease-taken-while-held")
    plan = report.partition("minimal plan")[2].splitlines()[1:-1]
    assert 2 <= len(plan) <= 4, report
    assert all("acquire" in line for line in plan[:2]), report
    assert f"python -m tests.simulation --seed {seed} --steps" in report


def test_plans_contain_every_operation_and_every_fault() -> None:
    kinds = {step.kind for seed in range(SEEDS) for step in create(seed)}
    assert kinds == {*OPERATIONS, *FAULTS}


def test_a_plan_is_reduced_to_the_steps_that_fail() -> None:
    plan = create(CHAOTIC)
    assert shrink(plan, lambda steps: plan[2] in steps and plan[7] in steps) == [plan[2], plan[7]]


def _require_no_violation(seeds: range) -> None:
    """Run seeds on all cores; the first failure is reported with its minimal plan."""
    for outcome in runs.run_seeds(seeds):
        if outcome.violations:
            pytest.fail(runs.report(outcome.seed), pytrace=False)
