"""Mutation testing: scores, intervals, and survivors without a reason."""

from pathlib import Path

import pytest

from tests.harness.mutation import report
from tests.harness.mutation.report import Mutant

LISTED = {"module.function: a < b → a <= b": "equal values have the same result"}


def mutants(killed: int, *survivors: str) -> list[Mutant]:
    return [
        *(Mutant("module.function", "", "killed") for _ in range(killed)),
        *(Mutant("module.function", mutation, "survived") for mutation in survivors),
    ]


def test_a_sample_has_an_interval_and_all_mutants_have_none() -> None:
    sampled = report.score(mutants(90, *["x"] * 10), {}, total=1000)
    assert sampled.share == 0.9
    assert sampled.interval == pytest.approx((0.826, 0.945), abs=5e-4), "Wilson"
    assert report.score(mutants(90, *["x"] * 10), {}, total=100).interval == (0.9, 0.9)


def test_untested_and_timed_out_mutants_count_as_survivors_and_as_detected() -> None:
    scored = report.score([Mutant("f", "", status) for status in ("killed", "timeout", "no tests")], {}, total=3)
    assert (scored.killed, scored.timeout, scored.unlisted) == (1, 1, ("f: ",))


def test_survivors_without_a_reason_and_low_scores_fail() -> None:
    listed, unlisted = "a < b → a <= b", "a + b → a - b"
    scored = report.score(mutants(19, listed), LISTED, total=20)
    assert (scored.listed, report.failures({"control": scored})) == (1, [])
    assert "| control | 20 | 20 | 19 | 0 | 1 | 0 | 95.0% |" in report.page({"control": scored}, LISTED)
    (failure,) = report.failures({"control": report.score(mutants(18, listed, unlisted), LISTED, total=20)})
    assert failure.endswith("module.function: a + b → a - b")
    assert "below 90%" in report.failures({"control": report.score(mutants(8, listed), LISTED, total=9)})[0]


def test_each_listed_survivor_has_a_reason_and_is_listed_once(tmp_path: Path) -> None:
    for name, mutant in (("actions", "f: a → b"), ("control", "g: c → d")):
        text = f"""[[survivors]]\nreason = "log"\nmutants = ["{mutant}"]\n"""
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    assert report.read_listed(tmp_path) == {"f: a → b": "log", "g: c → d": "log"}
    assert all(report.read_listed().values())
