"""Marks of other programs are heard in the order of their times; parts of a path add up to the whole."""

import time
from contextlib import ExitStack, closing

import pytest

from benchmarks.suites.path import ANSWERED, ASKED, parts, whole
from benchmarks.tracing.timestamps import Mark, Marks, Teller

STEPS = (("in", "there"), ("out", "work"), (ANSWERED, "back"))


def test_what_is_told_is_heard_at_once_with_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        marks = stack.enter_context(Marks())
        for name, value in marks.settings.items():
            monkeypatch.setenv(name, value)
        teller = stack.enter_context(closing(Teller()))
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
        Mark("out", 500_000),  # of an exchange before
        Mark(ASKED, 1_000_000),
        Mark("in", 3_000_000),
        Mark("else", 3_500_000),
        Mark("out", 6_000_000),
        Mark("in", 7_000_000),
        Mark(ANSWERED, 10_000_000),
    ]
    found = parts(marks, STEPS)
    assert found == {"there": 2.0, "work": 3.0, "back": 4.0}
    assert whole([found]) == [9.0]


def test_what_was_not_told_whole_has_no_parts() -> None:
    assert parts([Mark(ASKED, 0), Mark("in", 1), Mark(ANSWERED, 2)], STEPS) is None
    assert parts([Mark(ASKED, 0), Mark("out", 1), Mark("in", 2), Mark(ANSWERED, 3)], STEPS) is None, "in another order"
