"""Marks of other programs are heard in the order of their times; parts of a path add up to the whole."""

import time
from contextlib import ExitStack, closing

import pytest

from benchmarks.suites.path import ANSWERED, ASKED, parts, whole
from benchmarks.tracing.timestamps import Timestamp, TimestampReceiver, TimestampSender

STEPS = (("in", "there"), ("out", "work"), (ANSWERED, "back"))


def test_what_is_told_is_heard_at_once_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        marks = stack.enter_context(TimestampReceiver())
        for name, value in marks.settings.items():
            monkeypatch.setenv(name, value)
        teller = stack.enter_context(closing(TimestampSender()))
        began_ns = time.monotonic_ns()
        teller.tell("one")
        teller.tell("two")
        found = marks.drain()
        assert [mark.name for mark in found] == ["one", "two"]
        assert began_ns <= found[0].at_ns <= found[1].at_ns <= time.monotonic_ns()
        assert marks.drain() == []
        teller.tell("old")
        teller.tell("new")
        assert [mark.name for mark in marks.until("new", since_ns=began_ns, within_s=1)] == ["old", "new"]
        with pytest.raises(TimeoutError, match="no mark 'never'"):
            marks.until("never", since_ns=began_ns, within_s=0.01)
        teller.tell("early")
        with pytest.raises(TimeoutError):
            marks.until("early", since_ns=time.monotonic_ns(), within_s=0.01)


def test_parts_run_from_each_step_to_the_next_and_add_up() -> None:
    marks = [
        Timestamp("out", 500_000),  # of an exchange before
        Timestamp(ASKED, 1_000_000),
        Timestamp("in", 3_000_000),
        Timestamp("else", 3_500_000),
        Timestamp("out", 6_000_000),
        Timestamp("in", 7_000_000),
        Timestamp(ANSWERED, 10_000_000),
    ]
    found = parts(marks, STEPS)
    assert found == {"there": 2.0, "work": 3.0, "back": 4.0}
    assert whole([found]) == [9.0]


def test_what_was_not_told_whole_has_no_parts() -> None:
    assert parts([Timestamp(ASKED, 0), Timestamp("in", 1), Timestamp(ANSWERED, 2)], STEPS) is None
    assert (
        parts([Timestamp(ASKED, 0), Timestamp("out", 1), Timestamp("in", 2), Timestamp(ANSWERED, 3)], STEPS) is None
    ), "in another order"
