"""Finds a minimal plan for a violation: removes steps while the violation remains (delta debugging)."""

from collections.abc import Callable, Sequence

from tests.simulation.plan import Step

MAX_RUNS = 300
"""Limit of the number of simulations; the smallest plan found so far is then returned."""


def shrink(steps: Sequence[Step], fails: Callable[[Sequence[Step]], bool], *, max_runs: int = MAX_RUNS) -> list[Step]:
    """A plan that fails, and none of whose steps can be removed (Zeller and Hildebrandt, 2002).

    Args:
        steps: A plan that fails.
        fails: Whether a plan fails in the same way.
        max_runs: Most calls of ``fails``.
    """
    current, parts, runs = list(steps), 2, 0
    while len(current) > 1 and runs < max_runs:
        size = -(-len(current) // parts)
        chunks = [current[first : first + size] for first in range(0, len(current), size)]
        for index in range(len(chunks)):
            candidate = [step for other, chunk in enumerate(chunks) if other != index for step in chunk]
            runs += 1
            if fails(candidate):
                current, parts = candidate, max(parts - 1, 2)
                break
        else:
            if parts >= len(current):
                break
            parts = min(len(current), 2 * parts)
    return current
