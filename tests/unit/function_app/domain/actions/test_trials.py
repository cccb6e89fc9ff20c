"""Success rates count verdicts only, with the interval that the command line prints."""

from dataclasses import replace

import pytest

from device_agent.cli.trials.success_rate import wilson_interval
from function_app.domain.actions.trials import SuccessRate, Trial, TrialState, rate_of

TRIAL = Trial(
    action="a",
    device="d",
    robot_type="t",
    task="task",
    movement="m",
    movement_version=1,
    tasks_sha256="",
    seed=1,
    epoch=1,
    caller="anna",
    started_ms=1,
)


def trials(*states: TrialState) -> list[Trial]:
    return [replace(TRIAL, state=state) for state in states]


def test_only_successes_and_failures_count() -> None:
    rate = rate_of(trials("success", "failed", "unknown", "running", "success", "unknown"))
    assert (rate.trials, rate.successes, rate.unknown) == (3, 2, 2)
    assert rate.rate == pytest.approx(2 / 3)


def test_there_is_no_rate_without_a_verdict() -> None:
    rate = rate_of(trials("running", "unknown"))
    assert (rate.rate, rate.interval) == (None, (0.0, 1.0))


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_the_interval_is_the_one_of_the_command_line(count: int) -> None:
    for successes in range(count + 1):
        assert SuccessRate(count, successes).interval == pytest.approx(wilson_interval(successes, count), abs=1e-15)
