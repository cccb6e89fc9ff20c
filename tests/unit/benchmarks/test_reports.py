"""The generated pages match their inputs, and claims that do not hold are marked."""

import pytest

from benchmarks import suites
from benchmarks.__main__ import main
from benchmarks.baseline.interleaved import measure_interleaved, table
from benchmarks.reporting import cost_model, page
from benchmarks.reporting.report import Claim, Report, Table, format_cell, load, percentile, save

HOLDS = Claim(text="quick", measured=1.4, bound=1.5, unit="×")
FAILS = Claim(text="many", measured=0.3, bound=0.4, unit="of it", at_least=True)
REPORT = Report(
    suite="limit",
    title="Lower bounds",
    about=["Description."],
    quick=True,
    claims=[HOLDS, FAILS],
    tables=[Table(title="T", columns=["path", "n", "p50 ms", "x"], rows=[["a", 1200, 0.01234, None]])],
)


def test_the_generated_pages_match_their_inputs() -> None:
    results = page.reports()
    assert [report.suite for report in results] == list(suites.NAMES)
    text = page.PAGE.read_text(encoding="utf-8")
    assert text == page.text(results), "run `python -m benchmarks.reporting.page`"
    text = cost_model.PAGE.read_text(encoding="utf-8")
    assert text == "\n".join(cost_model.lines()) + "\n", "run `python -m benchmarks.reporting.cost_model`"


def test_a_claim_that_does_not_hold_is_marked() -> None:
    text = page.text([REPORT])
    assert "| quick | ≤ 1.5 × | 1.4 × |" in text
    assert "| many | ≥ 0.4 of it | 0.3 of it **not reached** |" in text
    assert "[limit](#lower-bounds)" in text
    assert "| a | 1,200 | 0.0123 | – |" in text


def test_saved_reports_are_loaded(tmp_path) -> None:
    save(REPORT, tmp_path)
    assert (load("limit", tmp_path), load("unknown", tmp_path)) == (REPORT, None)


def test_percentiles_are_samples() -> None:
    assert [percentile([4.0, 1.0, 3.0, 2.0, 5.0], share) for share in (0.0, 0.5, 1.0)] == [1.0, 3.0, 5.0]
    with pytest.raises(ValueError, match="no sample"):
        percentile([], 0.5)
    cells = [format_cell(each) for each in (0.123456, 12.3456, 123.456, 1e6, 12_000, None)]
    assert cells == ["0.123", "12.3", "123", "1000000", "12,000", "–"]


@pytest.mark.slow
def test_interleaved_paths_run_in_each_round_and_may_return_their_own_time() -> None:
    order: list[str] = []

    def path(name: str, own_ms: float | None) -> float | None:
        order.append(name)
        return own_ms

    paths = {"a": lambda: path("a", 2.0), "b": lambda: path("b", None)}
    samples = measure_interleaved(paths, rounds=3, each=2, warm_up=1)
    assert samples["a"] == [2.0] * 6
    assert len(samples["b"]) == 6
    assert sorted(order[2:6]) == ["a", "a", "b", "b"]
    assert [row[-1] for row in table("T", {"a": [2.0], "b": [3.0]}, reference="a").rows] == [1.0, 1.5]


def test_load_grows_with_the_number_of_robots() -> None:
    assumptions = {
        "state_every_s": 10, "commands_a_day": 86_400, "answers_a_command": 1, "retained_a_robot": 3,
        "credentials_good_s": 100, "credentials_renewed_at": 0.5, "stored_every_s": 2, "rows_a_store": 7,
        "write_units_a_row": 2, "subscribers": 1,
    }  # fmt: skip
    demand = cost_model.demand({name: {"value": value, "why": ""} for name, value in assumptions.items()}, 10, 0.9, 100)
    assert {name: demand[name] for name in ("in_per_s", "in_bytes_per_s", "stores_per_s")} == pytest.approx(
        {"in_per_s": 10 * (0.9 + 0.1 + 2), "in_bytes_per_s": 3000, "stores_per_s": 5}
    )
    assert (demand["write_units_per_s"], demand["credentials_per_s"]) == pytest.approx((70, 0.2))


def test_unknown_prices_are_shown_as_a_formula() -> None:
    assert cost_model.cost({"A": {"value": None}}, "A", 12.0) == "12 x A"
    assert cost_model.cost({"A": {"value": 0.5}}, "A", 12.0) == "6 $"
    steps = [{"known": known, "processor_ms_each": 1 + known / 10} for known in (100, 200, 400)]
    assert cost_model.slope_s(steps) == pytest.approx(1e-4)


def test_an_interrupted_suite_ends_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(**_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("benchmarks.suites.kills.run", interrupted)
    monkeypatch.setattr("sys.argv", ["benchmarks", "kills", "--quick"])
    assert main() == 130
    assert "has no report" in capsys.readouterr().err
