"""The benchmark page matches the results and marks claims that do not hold."""

import pytest

from benchmarks import suites
from benchmarks.baseline.interleaved import measure_interleaved, table
from benchmarks.reporting import page
from benchmarks.reporting.report import Claim, Report, Table, format_cell, load, percentile, save


def report(*claims: Claim) -> Report:
    rows: list[list[str | float | int | None]] = [["a", 1200, 0.01234, None]]
    return Report(
        suite="limit",
        title="Against the limit",
        about=["What was done."],
        quick=True,
        claims=list(claims),
        tables=[Table(title="T", columns=["path", "n", "p50 ms", "x"], rows=rows)],
    )


def test_the_page_is_what_the_results_say() -> None:
    assert page.PAGE.read_text(encoding="utf-8") == page.text(page.reports()), (
        "run `python -m benchmarks.reporting.page`"
    )


def test_every_suite_has_results() -> None:
    assert [found.suite for found in page.reports()] == list(suites.NAMES)


def test_a_claim_that_does_not_hold_is_told_as_such() -> None:
    holds = Claim(text="quick", seen=1.4, bound=1.5, unit="×")
    fails = Claim(text="many", seen=0.3, bound=0.4, unit="of it", at_least=True)
    told = page.text([report(holds, fails)])
    assert "| quick | ≤ 1.5 × | 1.4 × |" in told
    assert "| many | ≥ 0.4 of it | 0.3 of it **not reached** |" in told
    assert "[limit](#against-the-limit)" in told
    assert "| a | 1,200 | 0.0123 | – |" in told


def test_what_is_saved_is_read_again(tmp_path) -> None:
    wanted = report(Claim(text="quick", seen=1.4, bound=1.5, unit="×"))
    save(wanted, tmp_path)
    assert load("limit", tmp_path) == wanted
    assert load("nothing", tmp_path) is None


def test_percentiles_are_samples() -> None:
    assert [percentile([4.0, 1.0, 3.0, 2.0, 5.0], share) for share in (0.0, 0.5, 1.0)] == [1.0, 3.0, 5.0]
    with pytest.raises(ValueError, match="no sample"):
        percentile([], 0.5)
    assert [format_cell(each) for each in (0.123456, 12.3456, 123.456, 1e6, 12_000, None)] == [
        "0.123", "12.3", "123", "1000000", "12,000", "–"
    ]  # fmt: skip


def test_paths_take_turns_and_may_tell_their_own_time() -> None:
    order: list[str] = []

    def path(name: str, own: float | None) -> float | None:
        order.append(name)
        return own

    found = measure_interleaved(
        {"a": lambda: path("a", 2.0), "b": lambda: path("b", None)}, rounds=3, each=2, warm_up=1
    )
    assert found["a"] == [2.0] * 6
    assert len(found["b"]) == 6
    assert sorted(order[2:6]) == ["a", "a", "b", "b"], "each has its turn in each round"
    made = table("T", {"a": [2.0], "b": [3.0]}, against="a")
    assert [row[-1] for row in made.rows] == [1.0, 1.5]
