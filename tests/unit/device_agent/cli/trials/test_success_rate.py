"""The confidence interval of a success rate."""

import pytest

from device_agent.cli.trials.success_rate import wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "lower", "upper"),
    [
        (0, 0, 0.0, 1.0),
        (0, 10, 0.0, 0.2775),  # Newcombe 1998 and Brown, Cai and DasGupta 2001 list such values
        (10, 10, 0.7225, 1.0),
        (81, 263, 0.2553, 0.3662),  # Newcombe 1998, table I
        (15, 148, 0.0624, 0.1605),
        (1, 29, 0.0061, 0.1718),
        (300, 300, 0.9874, 1.0),
    ],
)
def test_the_interval_has_published_values(successes: int, trials: int, lower: float, upper: float) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((lower, upper), abs=1e-4)
