"""A process that is killed between any two writes loses no data, and the timer ends all its open actions.

The in-memory tests kill each operation at every step. Real processes end by SIGKILL, with their store connections.
"""

import contextlib
from functools import partial

import pytest

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.services.storage import records
from tests.harness.processes import Place, Work, kill, run_here
from tests.integration.kills.scenes import CASES, Scene, check_scenes, join_queue, rows_of, start_with_key

MOST_STEPS = 60


def check_kills(place: Place, case: str) -> None:
    """Kill the operation at each of its steps, repeat it as an operator would, and check the result."""
    prepare, operation, at_least = CASES[case]
    scenes = []
    for step in range(MOST_STEPS):
        scene = run_here(place, prepare)
        scenes.append(scene)
        survived = not kill(place, operation, scene, at=step)
        if case != "timer":
            run_here(place, partial(repeat, operation=operation, scene=scene))
        if survived:
            assert step >= at_least, f"only {step} steps"
            return run_here(place, lambda functions: check_scenes(functions, place, scenes))
    pytest.fail(f"{case} has more than {MOST_STEPS} steps")


async def repeat(functions: Functions, operation: Work, scene: Scene) -> None:
    """Repeat an operation; it may be rejected because it has succeeded already."""
    with contextlib.suppress(Problem, pytest.fail.Exception):
        await operation(functions, scene)
    if operation in {start_with_key, join_queue}:
        rows = await rows_of(functions, records.CONTROL, scene.device)
        keyed = [key for key, data in rows.items() if key.startswith("action:") and data["idempotency_key"]]
        assert len(keyed) == 1, "one idempotency key must create one action, also after a kill"


@pytest.mark.parametrize("place", ["memory"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_an_operation_killed_at_any_step_leaves_no_open_action(place: Place, case: str) -> None:
    check_kills(place, case)


@pytest.mark.parametrize("place", ["local"], indirect=True)
def test_a_process_killed_at_any_step_leaves_no_open_action(place: Place) -> None:
    check_kills(place, "hand over")


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("place", ["local", "azure", "aws"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_a_process_killed_at_any_step_leaves_no_open_action_in_every_store(place: Place, case: str) -> None:
    check_kills(place, case)
