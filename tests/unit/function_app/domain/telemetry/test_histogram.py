"""Quantiles stay within the documented error; merging equals recording all samples."""

import math
import random
from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from function_app.domain.telemetry.histogram import ERROR, LONGEST_MS, SHORTEST_MS, Histogram, merge, of

times_ms = st.floats(min_value=0, max_value=LONGEST_MS, allow_nan=False)
samples = st.lists(times_ms, min_size=1, max_size=200)
SHARES = (0.0, 0.01, 0.5, 0.9, 0.95, 0.99, 0.999, 1.0)


def exact(values: list[float], share: float) -> float:
    """The sample of rank ⌈share·count⌉."""
    return sorted(values)[max(1, math.ceil(share * len(values))) - 1]


def check(values: list[float]) -> None:
    histogram = of(values)
    for share in SHARES:
        true = exact(values, share)
        if true >= SHORTEST_MS:
            assert histogram.quantile(share) == pytest.approx(true, rel=ERROR * (1 + 1e-9)), share
        else:
            assert histogram.quantile(share) <= SHORTEST_MS * (1 + ERROR)


@given(samples)
def test_quantiles_are_within_one_percent_of_the_exact_ones(values: list[float]) -> None:
    check(values)


def test_quantiles_of_ten_thousand_samples() -> None:
    rng = random.Random(3)  # noqa: S311 (repeatable samples)
    for draw in (
        lambda: rng.lognormvariate(3.0, 0.8),
        lambda: rng.gauss(20, 1) if rng.random() < 0.9 else rng.gauss(900, 50),
        lambda: 12.5,
        lambda: rng.expovariate(0.02),
    ):
        check([draw() for _ in range(10_000)])


@given(st.lists(samples, min_size=1, max_size=6), st.randoms())
def test_merged_parts_are_the_whole_in_any_order(parts: list[list[float]], rng: random.Random) -> None:
    whole = asdict(of([value for part in parts for value in part]))
    histograms = [of(part) for part in parts]
    rng.shuffle(histograms)
    merged = merge(merge([one]) if rng.random() < 0.5 else one for one in histograms)
    result = asdict(merged)
    assert result.pop("sum_ms") == pytest.approx(whole.pop("sum_ms"))
    assert result == whole


def test_bins_contain_every_sample_and_the_mean_has_no_error() -> None:
    values = [0.5, 1.0, 1.0, 20.0, 3_000.0]
    histogram = of(values)
    assert sum(count for _, _, count in histogram.bins()) == len(values)
    for value in values:
        assert any(lower < value <= upper * (1 + 1e-12) for lower, upper, _ in histogram.bins()), value
    assert histogram.mean_ms == pytest.approx(sum(values) / len(values))


def test_an_empty_histogram() -> None:
    assert merge([]) == of([]) == Histogram()
    assert Histogram().mean_ms == 0
    with pytest.raises(ValueError, match="no samples"):
        Histogram().quantile(0.5)


@pytest.mark.parametrize("value", [-0.1, LONGEST_MS * 2, math.inf, math.nan])
def test_invalid_times_are_rejected(value: float) -> None:
    with pytest.raises(ValueError, match="a time is"):
        of([1.0, value])
