"""Runs simulations by seed, and reports failures as a minimal plan."""

import os
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from typing import NamedTuple

from tests.simulation import planted
from tests.simulation.checks.history import History, Violation
from tests.simulation.plan import Step, create
from tests.simulation.shrink import shrink
from tests.simulation.world import World

BATCH = 25
ROUND = 400
"""Seeds after which new processes continue: a simulation leaves objects behind, such as caches, 0.8 MB each."""


class Outcome(NamedTuple):
    """The result of one simulation."""

    seed: int
    digest: str
    violations: tuple[Violation, ...]


def run(seed: int, steps: Sequence[Step] | None = None, *, defect: str = "") -> History:
    """Run one simulation.

    Args:
        seed: Decides the plan and all random numbers.
        steps: The steps of the plan to perform; ``None``: all.
        defect: Name of a planted defect; empty: none.
    """
    with ExitStack() as stack:
        if defect:
            stack.enter_context(planted.DEFECTS[defect]())
        return World(seed).run(create(seed) if steps is None else steps)


def run_batch(seeds: Sequence[int], defect: str = "") -> list[Outcome]:
    """Run some seeds, in this process."""
    outcomes = []
    for seed in seeds:
        history = run(seed, defect=defect)
        outcomes.append(Outcome(seed, history.digest, tuple(history.violations)))
    return outcomes


def run_seeds(seeds: range, *, defect: str = "", workers: int | None = None) -> Generator[Outcome]:
    """Run seeds on all cores; results are in order of the seeds."""
    for start in range(0, len(seeds), ROUND):
        chosen = seeds[start : start + ROUND]
        batches = [chosen[first : first + BATCH] for first in range(0, len(chosen), BATCH)]
        # Not `max_tasks_per_child`, which blocks forever in Python 3.11.
        with ProcessPoolExecutor(workers or os.cpu_count()) as pool:
            for outcomes in pool.map(run_batch, batches, [defect] * len(batches)):
                yield from outcomes


def minimal(seed: int, kind: str, *, defect: str = "") -> list[Step]:
    """The smallest plan of a seed that still leads to a violation of this kind."""

    def fails(steps: Sequence[Step]) -> bool:
        return any(violation.kind == kind for violation in run(seed, steps, defect=defect).violations)

    return shrink(create(seed), fails)


def report(seed: int, *, defect: str = "") -> str:
    """Seed, violations, and the minimal plan of the first one, readable."""
    violations = run(seed, defect=defect).violations
    if not violations:
        return f"seed {seed}: no violation"
    steps = minimal(seed, violations[0].kind, defect=defect)
    numbers = ",".join(str(step.number) for step in steps)
    replay = f"python -m tests.simulation --seed {seed} --steps {numbers}" + (f" --planted {defect}" if defect else "")
    lines = [
        f"seed {seed}: {len(violations)} violations",
        *(f"  {violation}" for violation in violations),
        f"minimal plan for '{violations[0].kind}':",
        *(f"  {step}" for step in steps),
        f"replay with a trace: {replay}",
    ]
    return "\n".join(lines)
