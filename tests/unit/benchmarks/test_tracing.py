"""Timestamps of traced programs are received in order, and the parts of a path add up to the total."""

import os
import subprocess
import sys
import time
from contextlib import closing
from types import SimpleNamespace

import pytest

from benchmarks.suites.path import REQUESTED, RESPONDED, parts, totals
from benchmarks.tracing import traced_programs
from benchmarks.tracing.timestamps import VARIABLE, Timestamp, TimestampReceiver, TimestampSender
from tests.harness.paths import ROOT

STEPS = (("in", "request"), ("out", "work"), (RESPONDED, "response"))


def test_timestamps_are_received_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    with TimestampReceiver() as receiver:
        for name, value in receiver.settings.items():
            monkeypatch.setenv(name, value)
        with closing(TimestampSender()) as sender:
            started_ns = time.monotonic_ns()
            sender.send("one")
            sender.send("two")
            first, second = receiver.drain()
            assert (first.name, second.name) == ("one", "two")
            assert started_ns <= first.at_ns <= second.at_ns <= time.monotonic_ns()
            sender.send("new")
            assert [each.name for each in receiver.until("new", since_ns=started_ns, within_s=1)] == ["new"]
            sender.send("early")
            with pytest.raises(TimeoutError, match="no timestamp 'early'"):
                receiver.until("early", since_ns=time.monotonic_ns(), within_s=0.01)


def test_parts_run_from_each_step_to_the_next_and_add_up() -> None:
    timestamps = [
        Timestamp("out", 500_000),  # of the previous exchange
        Timestamp(REQUESTED, 1_000_000),
        Timestamp("in", 3_000_000),
        Timestamp("else", 3_500_000),
        Timestamp("out", 6_000_000),
        Timestamp("in", 7_000_000),
        Timestamp(RESPONDED, 10_000_000),
    ]
    durations = parts(timestamps, STEPS)
    assert durations == {"request": 2.0, "work": 3.0, "response": 4.0}
    assert totals([durations]) == [9.0]


@pytest.mark.parametrize("names", [[REQUESTED, "in", RESPONDED], [REQUESTED, "out", "in", RESPONDED]])
def test_incomplete_and_unordered_exchanges_have_no_parts(names: list[str]) -> None:
    assert parts([Timestamp(name, number) for number, name in enumerate(names)], STEPS) is None


@pytest.mark.slow
@pytest.mark.parametrize("program", ["functions", "agent"])
def test_every_traced_function_exists(program: str) -> None:
    command = [sys.executable, "-m", "benchmarks.tracing.traced_programs", program, "--help"]
    environment = os.environ | {VARIABLE: "9"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: " in done.stdout, "the help is printed after every function was wrapped"


def test_motion_is_reported_once_and_rest_after_a_delay() -> None:
    reports: list[str] = []
    motion = traced_programs.Motion("arm", reports.append)
    for speed, times in ((1e-6, 25), (1e-4, 3), (0.01, 3), (1e-6, 24), (0.01, 2), (1e-6, 50), (1e-4, 1)):
        for _ in range(times):
            motion.update(speed)
    assert reports == ["rests:arm", "moves:arm", "fast:arm", "rests:arm", "rests:arm", "moves:arm"]


def test_a_wrapped_function_is_reported_and_called() -> None:
    calls: list[object] = []

    def call(one: int, *, two: int) -> str:
        calls.append((one, two))
        return "done"

    owner = SimpleNamespace(call=call)
    traced_programs._wrap(owner, "call", traced_programs._mark_before(calls.append))
    assert owner.call(1, two=2) == "done"
    assert calls == [1, (1, 2)]
