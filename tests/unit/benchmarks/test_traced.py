"""Every public function at which the traced programs tell something is still there."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from benchmarks.tracing import traced_programs
from benchmarks.tracing.timestamps import VARIABLE
from tests.harness.paths import ROOT


@pytest.mark.parametrize("program", ["functions", "agent"])
def test_every_traced_function_exists(program: str) -> None:
    # Its help is printed after every function was wrapped; one that is gone would end it before.
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.tracing.traced_programs", program, "--help"],
        cwd=ROOT,
        env=os.environ | {VARIABLE: "9"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "usage: " in done.stdout


def test_motion_is_told_once_and_rest_only_after_a_while() -> None:
    told: list[str] = []
    motion = traced_programs.Motion("arm", told.append)
    for speed, times in ((1e-6, 25), (1e-4, 3), (0.01, 3), (1e-6, 24), (0.01, 2), (1e-6, 50), (1e-4, 1)):
        for _ in range(times):
            motion.see(speed)
    assert told == ["rests:arm", "moves:arm", "fast:arm", "rests:arm", "rests:arm", "moves:arm"]


def test_a_function_that_is_gone_ends_the_program_with_its_name() -> None:
    with pytest.raises(AttributeError, match="vanished"):
        traced_programs._wrap(SimpleNamespace(), "vanished", lambda call: call)


def test_what_is_wrapped_is_told_first_and_still_done() -> None:
    told: list[object] = []

    def call(one: int, *, two: int) -> str:
        told.append((one, two))
        return "done"

    owner = SimpleNamespace(call=call)
    traced_programs._wrap(owner, "call", traced_programs._told_first(told.append))
    assert owner.call(1, two=2) == "done"
    assert told == [1, (1, 2)]
