"""A process that is killed between any two writes leaves nothing that the timer does not end, and loses nothing.

In memory every step of every operation is tried. Real processes end by SIGKILL, so that a store is killed with them.
"""

import contextlib
from functools import partial

import pytest

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.services.storage import records
from tests.harness.processes import Place, Work, kill, run_here
from tests.integration.kills.scenes import CASES, Scene, join_queue, look, rows_of, start_once

MOST_STEPS = 60


def check_kills(place: Place, case: str) -> None:
    """Kill the operation at each of its steps, repeat it as an operator would, and check what is left."""
    made, work, at_least = CASES[case]
    scenes = []
    for step in range(MOST_STEPS):
        scene = run_here(place, made)
        scenes.append(scene)
        survived = not kill(place, work, scene, at=step)
        if case != "timer":
            run_here(place, partial(repeat, work=work, scene=scene))
        if survived:
            assert step >= at_least, f"only {step} steps"
            return run_here(place, lambda functions: look(functions, place, scenes))
    pytest.fail(f"{case} has more than {MOST_STEPS} steps")


async def repeat(functions: Functions, work: Work, scene: Scene) -> None:
    """Repeat an operation; it may be rejected because it has succeeded already."""
    with contextlib.suppress(Problem, pytest.fail.Exception):
        await work(functions, scene)
    if work in {start_once, join_queue}:
        rows = await rows_of(functions, records.CONTROL, scene.device)
        keyed = [key for key, data in rows.items() if key.startswith("action:") and data["idempotency_key"]]
        assert len(keyed) == 1, "one idempotency key gives one action, also after a kill"


@pytest.mark.parametrize("place", ["memory"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_an_operation_killed_at_any_step_leaves_nothing_open(place: Place, case: str) -> None:
    check_kills(place, case)


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_a_process_killed_at_any_step_leaves_nothing_open(place: Place) -> None:
    check_kills(place, "hand over")


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("place", ["local", "azure", "aws"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_a_process_killed_at_any_step_leaves_nothing_open_in_every_store(place: Place, case: str) -> None:
    check_kills(place, case)
