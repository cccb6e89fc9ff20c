"""An action's life: steps may be skipped, never taken back, and the first end stays."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.actions.action import (
    GRACE_MS,
    RETRY_MS,
    AckReport,
    Action,
    NextStep,
    Status,
    apply_report,
    end,
    mark_published,
    next_check_ms,
    next_step,
    reached,
)

NEW = Action(
    id="agent00000-arm-00000000000000000000",
    device="agent00000-arm",
    account="a",
    who="anna",
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


def test_the_whole_life_in_order_has_every_time() -> None:
    action = applied(mark_published(NEW, 1_000_001), life(*LIFE))
    assert action.status is Status.DONE
    assert action.times == {
        "published": 1_000_001,
        "received": 1_000_101,
        "accepted": 1_000_102,
        "started": 1_000_103,
        "done": 1_000_105,
    }
    assert (action.progress, action.output) == (0.5, "line 5")


@pytest.mark.parametrize("order", list(permutations(range(len(LIFE)))))
def test_reports_in_any_order_end_alike(order: tuple[int, ...]) -> None:
    reports = life(*LIFE)
    action = applied(NEW, [reports[place] for place in order])
    assert (action.status, action.output, action.progress) == (Status.DONE, "line 5", 0.5)


reports_ = st.lists(
    st.builds(
        AckReport,
        status=st.sampled_from([status for status in Status if status.rank >= Status.RECEIVED.rank]),
        sequence=st.integers(min_value=0, max_value=6),
        at_ms=st.integers(min_value=0, max_value=10),
        progress=st.none() | st.floats(min_value=0, max_value=1),
        output=st.sampled_from(["", "a", "b"]),
    ),
    max_size=20,
)


@given(reports_)
def test_any_reports_never_take_a_step_back_and_the_first_end_stays(reports: list[AckReport]) -> None:
    action = NEW
    for report in reports:
        before, action = action, apply_report(action, report)
        assert action.status.rank >= before.status.rank
        assert action.sequence >= before.sequence
        assert before.times.items() <= action.times.items(), "a time that is known stays"
        if before.status.terminal:
            assert action is before
        if report.status.terminal and not before.status.terminal:
            assert action.status is report.status


@given(reports_, st.data())
def test_doubled_reports_change_nothing(reports: list[AckReport], data: st.DataObject) -> None:
    action = applied(NEW, reports)
    for report in data.draw(st.lists(st.sampled_from(reports), max_size=10)) if reports else []:
        again = apply_report(action, report)
        assert again.status is action.status
        assert again.sequence == action.sequence
        assert again.output == action.output


@given(st.sets(st.integers(min_value=0, max_value=4)), st.randoms(use_true_random=False))
def test_lost_and_shuffled_reports_reach_the_highest_that_arrived(lost: set[int], random: object) -> None:
    arrived = [report for number, report in enumerate(life(*LIFE)) if number not in lost]
    random.shuffle(arrived)  # type: ignore[attr-defined]
    action = applied(NEW, arrived)
    highest = max((report.status.rank for report in arrived), default=0)
    assert action.status.rank == highest


def test_the_same_object_comes_back_when_a_report_brings_nothing_new() -> None:
    reports = life(*LIFE[:3])
    action = applied(NEW, reports)
    assert all(apply_report(action, report) is action for report in reports)


def test_late_news_of_an_earlier_step_adds_its_time_only() -> None:
    received, _, started = life(*LIFE[:3])
    action = applied(NEW, [started, received])
    assert (action.status, action.output, action.progress) == (Status.STARTED, "line 3", 0.3)
    assert action.times == {"started": started.at_ms, "received": received.at_ms}


@pytest.mark.parametrize("first", ENDS)
@pytest.mark.parametrize("second", ENDS)
def test_the_first_end_stays_whoever_says_another(first: Status, second: Status) -> None:
    ended = apply_report(NEW, AckReport(first, 1, 5))
    assert apply_report(ended, AckReport(second, 2, 6)) is ended
    assert end(ended, second, "lost", "x", 7) is ended


def test_an_end_by_the_cloud_has_its_reason_and_time() -> None:
    ended = end(NEW, Status.EXPIRED, "no-answer", "Nobody came.", 77)
    assert (ended.status, ended.reason) == (Status.EXPIRED, {"code": "no-answer", "message": "Nobody came."})
    assert ended.times == {"expired": 77}
    assert apply_report(ended, AckReport(Status.DONE, 9, 9)) is ended


def test_publishing_is_noted_once_and_takes_no_step_back() -> None:
    published = mark_published(NEW, 5)
    assert (published.status, published.times) == (Status.PUBLISHED, {"published": 5})
    assert mark_published(published, 6) is published
    fast = mark_published(apply_report(NEW, AckReport(Status.DONE, 1, 4)), 5)
    assert (fast.status, fast.times) == (Status.DONE, {"done": 4, "published": 5})


@pytest.mark.parametrize(
    ("status", "wanted", "over"),
    [
        (Status.PUBLISHED, Status.STARTED, False),
        (Status.ACCEPTED, Status.STARTED, False),
        (Status.STARTED, Status.STARTED, True),
        (Status.STARTED, Status.DONE, False),
        (Status.FAILED, Status.STARTED, True),
        (Status.EXPIRED, Status.DONE, True),
    ],
)
def test_waiting_is_over_when_it_is_reached_or_can_not_be(status: Status, wanted: Status, over: bool) -> None:
    assert reached(replace(NEW, status=status), wanted) is over


@pytest.mark.parametrize(
    ("status", "after_ms", "verdict"),
    [
        (Status.CREATED, 0, NextStep.PUBLISH),
        (Status.PUBLISHED, 9_999, NextStep.PUBLISH),
        (Status.PUBLISHED, 10_000, NextStep.WAIT),
        (Status.PUBLISHED, 10_000 + GRACE_MS, NextStep.EXPIRE),
        (Status.RECEIVED, 10_000 + GRACE_MS, NextStep.WAIT),
        (Status.STARTED, 59_999, NextStep.WAIT),
        (Status.STARTED, 60_000, NextStep.LOSE),
        (Status.CREATED, 60_000, NextStep.LOSE),
    ],
)
def test_a_timer_repeats_what_nobody_answered_then_ends_it(status: Status, after_ms: int, verdict: NextStep) -> None:
    assert next_step(replace(NEW, status=status), NEW.created_ms + after_ms) is verdict


def test_what_was_cancelled_is_not_sent_again() -> None:
    cancelled = replace(NEW, status=Status.PUBLISHED, cancel_id="x")
    assert next_step(cancelled, NEW.created_ms + 5_000) is NextStep.CANCEL
    assert next_step(cancelled, NEW.created_ms + 10_000 + GRACE_MS) is NextStep.EXPIRE


@given(
    st.sampled_from([status for status in Status if not status.terminal][1:]),
    st.integers(min_value=0, max_value=59_999),
)
def test_the_next_look_is_later_and_never_after_the_deadline(status: Status, after_ms: int) -> None:
    now_ms = NEW.created_ms + after_ms
    due_ms = next_check_ms(replace(NEW, status=status), now_ms)
    assert now_ms < due_ms <= NEW.deadline_ms
    if status.rank < Status.RECEIVED.rank and now_ms < NEW.expires_ms:
        assert due_ms <= now_ms + RETRY_MS


def test_what_several_hear_was_heard_when_the_first_of_them_did() -> None:
    def heard(at_ms: int) -> AckReport:
        return AckReport(Status.RECEIVED, 1, 1_000_100, heard_ms=at_ms)

    action = applied(NEW, [heard(50), heard(30)])
    assert action.heard == {"received": 30}
    assert apply_report(action, heard(70)) is action
