"""Time limits of an action after the cloud's clock was set back."""

from dataclasses import replace

import pytest

from function_app.domain.actions.action import Action, NextStep, Status, after_set_back, next_step
from function_app.domain.common.timestamps import CLOCK_SKEW_MS

NOW_MS = 1_000_000
AHEAD_MS = CLOCK_SKEW_MS + 1
ACTION = Action(
    id="agent00000-arm-00000000000000000000",
    device="agent00000-arm",
    account="a",
    caller="anna",
    pairing="p",
    request={},
    epoch=1,
    created_ms=NOW_MS,
    ttl_ms=10_000,
    timeout_ms=60_000,
    deadline_ms=NOW_MS + 60_000,
)


def queued(ahead_ms: int) -> Action:
    created_ms = NOW_MS + ahead_ms
    return replace(
        ACTION,
        status=Status.QUEUED,
        created_ms=created_ms,
        queued_until_ms=created_ms + 30_000,
        deadline_ms=created_ms + 90_000,
    )


def unknown(ahead_ms: int) -> Action:
    return replace(ACTION, status=Status.UNKNOWN, times={"started": 5, "unknown": NOW_MS + ahead_ms})


def running(ahead_ms: int) -> Action:
    return replace(ACTION, status=Status.STARTED, deadline_ms=NOW_MS + ahead_ms + 60_000)


def test_a_queued_action_keeps_its_queueing_time() -> None:
    assert after_set_back(queued(AHEAD_MS), NOW_MS) == queued(0)


def test_an_unknown_outcome_is_unknown_since_now() -> None:
    assert after_set_back(unknown(AHEAD_MS), NOW_MS) == unknown(0)


def test_a_running_action_has_its_whole_time_limit() -> None:
    assert after_set_back(running(AHEAD_MS), NOW_MS) == running(0)


@pytest.mark.parametrize(
    "action", [queued(CLOCK_SKEW_MS), unknown(CLOCK_SKEW_MS), running(CLOCK_SKEW_MS)], ids=lambda each: each.status
)
def test_plausible_limits_do_not_change(action: Action) -> None:
    assert after_set_back(action, NOW_MS) is action


def test_an_ended_action_does_not_change() -> None:
    ended = replace(running(AHEAD_MS), status=Status.DONE)
    assert after_set_back(ended, NOW_MS) is ended


@pytest.mark.parametrize(
    ("status", "ahead_ms", "step"),
    [
        (Status.PUBLISHED, CLOCK_SKEW_MS, NextStep.PUBLISH),
        (Status.PUBLISHED, AHEAD_MS, NextStep.DOUBT),
        (Status.STARTED, AHEAD_MS, NextStep.WAIT),
    ],
)
def test_an_unacknowledged_command_that_was_issued_in_the_future_is_in_doubt(
    status: Status, ahead_ms: int, step: NextStep
) -> None:
    assert next_step(replace(ACTION, status=status), NOW_MS - ahead_ms) is step
