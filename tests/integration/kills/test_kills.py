"""Processes that are killed with SIGKILL between any two writes: the timer ends what they left, and nothing is lost."""

import contextlib
from functools import partial

import pytest

from function_app.bootstrap import Functions
from function_app.domain.common.problems import Problem
from function_app.services.storage import records
from tests.harness.processes import (
    Place,
    Work,
    begin,
    killed,
    run_here,
)
from tests.integration.kills.scenes import CASES, MOST_STEPS, Scene, join_queue, look, rows_of, start_once

LONG_CASES = ("stop before a queue", "un-pair")
"""With so many steps that CI is content with every third one."""
"""What it starts from, what is done, and the steps that it has at least."""


def kill_at_every_step(place: Place, case: str, *, stride: int = 1) -> list[Scene]:
    """Do it once for each of its steps, killed there, until it comes through; then once more, as a person would.

    With a ``stride`` for one of so many steps.
    """
    made, work, at_least = CASES[case]
    scenes = []
    for step in range(0, MOST_STEPS, stride):
        scene = run_here(place, made)
        scenes.append(scene)
        victim = begin(place, work, scene, dies_at=step)
        survived = not killed(victim)
        if case != "timer":
            run_here(place, partial(again, work=work, scene=scene))
        if survived:
            assert step >= at_least, f"only {step} steps"
            return scenes
    pytest.fail(f"{case} has more than {MOST_STEPS} steps")


async def again(functions: Functions, work: Work, scene: Scene) -> None:
    """Repeat it; that it is refused because it is done already is an answer too."""
    with contextlib.suppress(Problem, pytest.fail.Exception):
        await work(functions, scene)
    if work in {start_once, join_queue}:
        device = await functions.devices.get(scene.who, scene.device)
        rows = await rows_of(functions, records.CONTROL, device.id)
        keyed = [key for key, data in rows.items() if key.startswith("action:") and data["once"]]
        assert len(keyed) == 1, "the same key is the same action, also after a kill"


@pytest.mark.parametrize("place", ["local"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_killed_at_any_step_it_leaves_nothing_without_an_end(place: Place, case: str) -> None:
    scenes = kill_at_every_step(place, case, stride=3 if case in LONG_CASES else 1)
    run_here(place, lambda functions: look(functions, place, scenes))


@pytest.mark.parametrize(
    ("place", "case"), [("azure", "the end before a queue"), ("aws", "start with a key")], indirect=["place"]
)
def test_so_it_is_over_the_clouds_stores(place: Place, case: str) -> None:
    scenes = kill_at_every_step(place, case)
    run_here(place, lambda functions: look(functions, place, scenes))


@pytest.mark.long
@pytest.mark.timeout(1_800)
@pytest.mark.parametrize("place", ["local", "azure", "aws"], indirect=True)
@pytest.mark.parametrize("case", CASES)
def test_killed_at_any_step_at_all_so_it_is_over_every_store(place: Place, case: str) -> None:
    scenes = kill_at_every_step(place, case)
    run_here(place, lambda functions: look(functions, place, scenes))
