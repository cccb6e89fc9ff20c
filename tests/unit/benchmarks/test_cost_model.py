"""The scale page agrees with its input files, and its arithmetic is correct."""

import pytest

from benchmarks.reporting import cost_model


def test_the_page_agrees_with_its_inputs() -> None:
    page = cost_model.PAGE.read_text(encoding="utf-8")
    assert page == "\n".join(cost_model.lines()) + "\n", "run `python -m benchmarks.reporting.cost_model`"


def test_load_grows_with_the_number_of_robots() -> None:
    def value(of: float) -> dict[str, object]:
        return {"value": of, "why": ""}

    assumed = {
        "state_every_s": value(10),
        "commands_a_day": value(86_400),
        "answers_a_command": value(1),
        "retained_a_robot": value(3),
        "credentials_good_s": value(100),
        "credentials_renewed_at": value(0.5),
        "stored_every_s": value(2),
        "rows_a_store": value(7),
        "write_units_a_row": value(2),
        "subscribers": value(1),
    }
    found = cost_model.demand(assumed, 10, 0.9, 100.0)
    assert found["in_per_s"] == pytest.approx(10 * (0.9 + 0.1 + 2))
    assert found["in_bytes_per_s"] == pytest.approx(3000)
    assert found["stores_per_s"] == pytest.approx(5)
    assert found["write_units_per_s"] == pytest.approx(70)
    assert found["credentials_per_s"] == pytest.approx(0.2)


def test_an_unknown_price_is_shown_as_a_formula() -> None:
    assert cost_model.cost({"A": {"value": None}}, "A", 12.0) == "12 x A"
    assert cost_model.cost({"A": {"value": 0.5}}, "A", 12.0) == "6 $"


def test_the_slope_is_that_of_a_line() -> None:
    steps = [{"known": known, "processor_ms_each": 1 + known / 10} for known in (100, 200, 400)]
    assert cost_model.slope_s(steps) == pytest.approx(1e-4)
