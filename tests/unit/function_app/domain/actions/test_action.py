"""The life cycle of an action: steps may be skipped, not reversed, and the first terminal status is final."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.actions.action import (
    ASK_MS,
    GRACE_MS,
    JOURNAL_MS,
    RETRY_MS,
    AckReport,
    Action,
    NextStep,
    Status,
    apply_report,
    end,
    give_turn,
    mark_published,
    may_reissue,
    next_check_ms,
    next_step,
    reached,
    reissue,
    withdraw,
)

NEW = Action(
    id="agent00000-arm-00000000000000000000",
    device="agent00000-arm",
    account="a",
    caller="anna",
    pairing="p",
    request={},
    epoch=1,
    created_ms=1_000_000,
    ttl_ms=10_000,
    deadline_ms=1_060_000,
)
LIFE = (Status.RECEIVED, Status.ACCEPTED, Status.STARTED, Status.STARTED, Status.DONE)
ENDS = (Status.DONE, Status.FAILED, Status.EXPIRED, Status.CANCELLED)


def life(*statuses: Status) -> list[AckReport]:
    """Reports as a device sends them: numbered, each with its own time and output."""
    return [
        AckReport(status, number, 1_000_100 + number, progress=number / 10, output=f"line {number}")
        for number, status in enumerate(statuses, start=1)
    ]


def applied(action: Action, reports: Sequence[AckReport]) -> Action:
    for report in reports:
        action = apply_report(action, report)
    return action


def test_acks_in_order_record_every_time() -> None:
    action = applied(mark_published(NEW, 1_000_001), life(*LIFE))
    offsets = {"published": 1, "received": 101, "accepted": 102, "started": 103, "done": 105}
    assert action.times == {name: 1_000_000 + offset_ms for name, offset_ms in offsets.items()}
    assert (action.status, action.progress, action.output) == (Status.DONE, 0.5, "line 5")


@pytest.mark.parametrize("order", list(permutations(range(len(LIFE)))))
def test_acks_in_any_order_have_the_same_result(order: tuple[int, ...]) -> None:
    reports = life(*LIFE)
    action = applied(NEW, [reports[index] for index in order])
    assert (action.status, action.output, action.progress) == (Status.DONE, "line 5", 0.5)


reports_ = st.lists(
    st.builds(
        AckReport,
        status=st.sampled_from((*LIFE[:3], *ENDS)),
        sequence=st.integers(min_value=0, max_value=6),
        at_ms=st.integers(min_value=0, max_value=10),
        progress=st.none() | st.floats(min_value=0, max_value=1),
        output=st.sampled_from(["", "a", "b"]),
    ),
    max_size=20,
)


@given(reports_)
def test_no_acks_reverse_a_step_and_the_first_terminal_status_is_final(reports: list[AckReport]) -> None:
    action = NEW
    for report in reports:
        before, action = action, apply_report(action, report)
        assert action.status.rank >= before.status.rank
        assert action.sequence >= before.sequence
        assert before.times.items() <= action.times.items(), "recorded times do not change"
        if before.status.terminal:
            assert action is before
        if report.status.terminal and not before.status.terminal:
            assert action.status is report.status


@given(reports_, st.data())
def test_duplicate_acks_change_nothing(reports: list[AckReport], data: st.DataObject) -> None:
    action = applied(NEW, reports)
    for report in data.draw(st.lists(st.sampled_from(reports), max_size=10)) if reports else []:
        result = apply_report(action, report)
        assert (result.status, result.sequence, result.output) == (action.status, action.sequence, action.output)


def test_a_late_ack_of_an_earlier_step_adds_its_time_only() -> None:
    reports = life(*LIFE[:3])
    action = applied(NEW, reports)
    assert all(apply_report(action, report) is action for report in reports)
    received, _, started = life(*LIFE[:3])
    action = applied(NEW, [started, received])
    assert (action.status, action.output, action.progress) == (Status.STARTED, "line 3", 0.3)
    assert action.times == {"started": started.at_ms, "received": received.at_ms}


@pytest.mark.parametrize("second", ENDS)
def test_an_end_by_the_cloud_has_reason_and_time_and_is_final(second: Status) -> None:
    ended = end(NEW, Status.EXPIRED, "no-answer", "No answer.", 77)
    assert (ended.status, ended.reason) == (Status.EXPIRED, {"code": "no-answer", "message": "No answer."})
    assert ended.times == {"expired": 77}
    assert apply_report(ended, AckReport(second, 9, 9)) is ended
    assert end(ended, second, "lost", "x", 78) is ended


def test_publishing_is_recorded_once_and_reverses_no_step() -> None:
    published = mark_published(NEW, 5)
    assert (published.status, published.times) == (Status.PUBLISHED, {"published": 5})
    assert mark_published(published, 6) is published
    fast = mark_published(apply_report(NEW, AckReport(Status.DONE, 1, 4)), 5)
    assert (fast.status, fast.times) == (Status.DONE, {"done": 4, "published": 5})


def test_waiting_ends_when_the_status_is_reached_or_impossible() -> None:
    early, ended = (Status.PUBLISHED, Status.ACCEPTED), (Status.STARTED, Status.FAILED, Status.DONE)
    assert not any(reached(replace(NEW, status=status), Status.STARTED) for status in early)
    assert all(reached(replace(NEW, status=status), Status.STARTED) for status in ended)
    assert not reached(replace(NEW, status=Status.STARTED), Status.DONE)
    assert reached(replace(NEW, status=Status.EXPIRED), Status.DONE)


@pytest.mark.parametrize(
    ("status", "after_ms", "expected"),
    [
        (Status.CREATED, 0, NextStep.PUBLISH),
        (Status.PUBLISHED, 9_999, NextStep.PUBLISH),
        (Status.PUBLISHED, 10_000, NextStep.ASK),
        (Status.PUBLISHED, 10_000 + GRACE_MS, NextStep.DOUBT),
        (Status.RECEIVED, 10_000 + GRACE_MS, NextStep.WAIT),
        (Status.STARTED, 59_999, NextStep.WAIT),
        (Status.STARTED, 60_000, NextStep.CANCEL),
        (Status.STARTED, 60_000 + GRACE_MS, NextStep.DOUBT),
        (Status.CREATED, 60_000, NextStep.DOUBT),
    ],
)
def test_the_timer_resends_commands_then_asks_for_outcomes(status: Status, after_ms: int, expected: NextStep) -> None:
    assert next_step(replace(NEW, status=status), NEW.created_ms + after_ms) is expected


def test_a_cancelled_action_is_not_republished() -> None:
    cancelled = replace(NEW, status=Status.PUBLISHED, cancel_id="x")
    assert next_step(cancelled, NEW.created_ms + 5_000) is NextStep.CANCEL
    assert next_step(cancelled, NEW.created_ms + 10_000) is NextStep.ASK
    expired = apply_report(cancelled, AckReport(Status.EXPIRED, 1, 5, reason={"code": "expired", "message": "late"}))
    assert (expired.status, expired.reason and expired.reason["code"]) == (Status.CANCELLED, "cancelled")
    assert expired.times == {"cancelled": 5}


@given(
    st.sampled_from((Status.CREATED, Status.PUBLISHED, *LIFE[:3])),
    st.integers(min_value=0, max_value=60_000 + GRACE_MS),
)
def test_the_next_check_is_later_and_not_after_the_next_step(status: Status, after_ms: int) -> None:
    now_ms = NEW.created_ms + after_ms
    due_ms = next_check_ms(replace(NEW, status=status), now_ms)
    assert now_ms < due_ms
    if status.rank < Status.RECEIVED.rank or now_ms >= NEW.deadline_ms:
        assert due_ms <= now_ms + RETRY_MS
    else:
        assert due_ms == NEW.deadline_ms


def unknown(*statuses: Status) -> Action:
    return end(applied(NEW, life(*statuses)), Status.UNKNOWN, "no-report", "Not reported.", 2_000_000)


@pytest.mark.parametrize("last", ENDS)
@pytest.mark.parametrize("before", [(), LIFE[:2], LIFE[:3]])
def test_a_report_ends_an_unknown_outcome(before: tuple[Status, ...], last: Status) -> None:
    doubtful = unknown(*before)
    assert not doubtful.status.terminal
    ended = apply_report(doubtful, AckReport(last, 9, 3_000_000))
    assert (ended.status, ended.reason) == (last, None)
    assert ended.times == doubtful.times | {last.value: 3_000_000}
    assert end(ended, Status.FAILED, "lost", "x", 4_000_000) is ended


@pytest.mark.parametrize("last", ENDS)
def test_a_report_replaces_a_lost_outcome(last: Status) -> None:
    """The cloud's clock may have been wrong when it gave up."""
    lost = end(unknown(), Status.FAILED, "lost", "Not reported.", 4_000_000)
    ended = apply_report(lost, AckReport(last, 9, 3_000_000))
    assert (ended.status, ended.reason) == (last, None)
    assert apply_report(lost, AckReport(Status.STARTED, 3, 3_000_000)).status is Status.FAILED


@pytest.mark.parametrize("last", ENDS)
def test_an_action_without_permission_fails_unless_the_device_has_completed_it(last: Status) -> None:
    withdrawn = withdraw(applied(NEW, life(*LIFE[:2])), "unshared", "Not shared.", 1_000_500)
    reason = {"code": "unshared", "message": "Not shared."}
    assert (withdrawn.status, withdrawn.reason) == (Status.UNKNOWN, reason)
    ended = apply_report(withdrawn, AckReport(last, 9, 1_000_600, reason={"code": "cancelled", "message": "x"}))
    expected = (Status.DONE, ended.reason) if last is Status.DONE else (Status.FAILED, reason)
    assert (ended.status, ended.reason) == expected
    assert withdraw(ended, "unshared", "Not shared.", 1_000_700) is ended


@pytest.mark.parametrize("last", [Status.CANCELLED, Status.EXPIRED])
def test_an_action_that_was_cancelled_before_its_permission_ended_is_cancelled(last: Status) -> None:
    """Simulation seed 1343: the worker was suspended, so the device's report arrived after the withdrawal."""
    withdrawn = withdraw(replace(NEW, cancel_id="c"), "unshared", "Not shared.", 1_000_500)
    ended = apply_report(withdrawn, AckReport(last, 9, 1_000_600, reason={"code": "cancelled", "message": "x"}))
    assert ended.status is Status.CANCELLED
    assert ended.reason is not None
    assert ended.reason["code"] == "cancelled"


def test_an_action_without_permission_is_cancelled_until_the_device_may_be_asked() -> None:
    withdrawn = withdraw(NEW, "unshared", "Not shared.", 1_000_500)
    assert next_step(withdrawn, NEW.expires_ms - 1) is NextStep.CANCEL, "the device would start it"
    assert next_step(withdrawn, NEW.expires_ms) is NextStep.ASK
    assert withdraw(withdrawn, "api-key-ended", "x", 1_000_600) is withdrawn


def test_progress_does_not_end_an_unknown_outcome() -> None:
    shown = apply_report(unknown(), AckReport(Status.STARTED, 3, 3_000_000, progress=0.5))
    assert (shown.status, shown.progress) == (Status.UNKNOWN, 0.5)
    assert shown.reason == {"code": "no-report", "message": "Not reported."}
    assert "started" in shown.times


def test_with_an_unknown_outcome_waiting_continues_for_what_has_not_happened() -> None:
    assert not reached(unknown(), Status.STARTED)
    assert not reached(unknown(*LIFE[:3]), Status.DONE)
    assert reached(unknown(*LIFE[:3]), Status.STARTED)


@given(st.integers(min_value=0, max_value=JOURNAL_MS - 1_000_001))
def test_the_device_is_asked_ever_less_often_and_the_outcome_is_lost_with_its_journal(after_ms: int) -> None:
    doubtful = unknown()
    now_ms = 2_000_000 + after_ms
    assert next_step(doubtful, now_ms) is NextStep.ASK
    pause_ms = next_check_ms(doubtful, now_ms) - now_ms
    assert 0 < pause_ms <= min(ASK_MS, max(RETRY_MS, after_ms))
    assert next_step(doubtful, NEW.created_ms + JOURNAL_MS - 1) is NextStep.ASK
    assert next_step(doubtful, NEW.created_ms + JOURNAL_MS) is NextStep.LOSE


def test_the_earliest_reception_of_an_ack_counts() -> None:
    early, later, last = (AckReport(Status.RECEIVED, 1, 1_000_100, received_ms=at_ms) for at_ms in (30, 50, 70))
    action = applied(NEW, [later, early])
    assert action.received == {"received": 30}
    assert apply_report(action, last) is action


QUEUED = replace(NEW, status=Status.QUEUED, epoch=0, timeout_ms=60_000, queued_until_ms=1_500_000, times={"queued": 1})


def test_a_turn_starts_time_to_live_and_time_limit() -> None:
    turn = give_turn(QUEUED, 4, 1_200_000)
    assert turn == replace(
        QUEUED,
        status=Status.CREATED,
        epoch=4,
        turn_ms=1_200_000,
        deadline_ms=1_260_000,
        times={"queued": 1, "created": 1_200_000},
    )
    assert (QUEUED.issued_ms, turn.issued_ms, turn.expires_ms) == (1_000_000, 1_200_000, 1_210_000)


@pytest.mark.parametrize(("after_ms", "step"), [(-1, NextStep.WAIT), (0, NextStep.EXPIRE)])
def test_a_queued_action_waits_until_its_time_ends(after_ms: int, step: NextStep) -> None:
    assert next_step(QUEUED, QUEUED.queued_until_ms + after_ms) is step
    assert next_check_ms(QUEUED, 5) == QUEUED.queued_until_ms
    assert apply_report(QUEUED, AckReport(Status.DONE, 1, 1)) is QUEUED, "it was never sent"


def test_an_ended_action_has_no_next_step() -> None:
    assert next_step(replace(NEW, status=Status.DONE), 0) is NextStep.ENDED


@pytest.mark.parametrize(
    ("changes", "device_epoch", "may"),
    [
        ({}, 1, True),
        ({}, 9, True),
        ({}, 0, False),
        ({"reissuable": False}, 9, False),
        ({"epoch": 0}, 9, False),
        ({"epoch": 0}, 0, False),
        ({"status": Status.UNKNOWN}, 9, False),
        ({"status": Status.FAILED}, 9, False),
    ],
)
def test_a_command_is_reissued_only_while_it_is_open_and_rejected(
    changes: dict[str, Any], device_epoch: int, may: bool
) -> None:
    assert may_reissue(replace(NEW, **({"reissuable": True} | changes)), device_epoch) is may


def test_a_reissued_command_starts_again_and_only_once() -> None:
    rejected = replace(
        applied(mark_published(NEW, 1_000_001), [AckReport(Status.RECEIVED, 3, 5, received_ms=7)]),
        reissuable=True,
        timeout_ms=60_000,
    )
    issued = reissue(rejected, 9, 1_002_000)
    assert (issued.times, issued.received, issued.sequence) == ({"created": 1_002_000}, {}, -1)
    assert (issued.epoch, issued.turn_ms, issued.deadline_ms) == (9, 1_002_000, 1_062_000)
    assert (issued.status, issued.reissuable) == (Status.CREATED, False)
    for epoch in (1, 8):
        assert apply_report(issued, AckReport(Status.FAILED, 4, 6, device_epoch=epoch)) is issued
    for epoch in (0, 9):
        assert apply_report(issued, AckReport(Status.FAILED, 4, 6, device_epoch=epoch)).status is Status.FAILED


@pytest.mark.parametrize(
    ("at_ms", "ended_ms"), [(1_030_000, 1_030_000), (5, NEW.created_ms), (9_999_999, NEW.deadline_ms)]
)
def test_the_end_is_limited_to_plausible_times(at_ms: int, ended_ms: int) -> None:
    assert apply_report(NEW, AckReport(Status.DONE, 1, at_ms)).ended_ms == ended_ms


def test_an_older_report_replaces_no_content_and_an_empty_one_keeps_it() -> None:
    reports = [
        AckReport(
            Status.STARTED, 2, 5, progress=0.5, output="new", result={"a": 1}, reason={"code": "c", "message": "m"}
        ),
        AckReport(Status.STARTED, 3, 6),
    ]
    action = applied(NEW, reports)
    kept = (0.5, "new", {"a": 1}, {"code": "c", "message": "m"})
    assert (action.progress, action.output, action.result, action.reason) == kept
    older = replace(NEW, status=Status.RECEIVED, sequence=5, output="new")
    late = apply_report(older, AckReport(Status.STARTED, 2, 5, progress=0.1, output="old", result={"b": 2}))
    assert (late.status, late.sequence, late.output, late.progress, late.result) == (Status.STARTED, 5, "new", None, {})
