"""Success rate of trials with its confidence interval."""

import math

_Z_95 = 1.959963984540054
"""Quantile of the normal distribution for 95 % on both sides."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Bounds of the 95 % Wilson score interval of a success rate, 0 to 1.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", 1927.

    Args:
        successes: Number of successful trials.
        trials: Number of trials; without trials, the interval is 0 to 1.
    """
    if not trials:
        return 0.0, 1.0
    rate, square = successes / trials, _Z_95**2
    center = (rate + square / (2 * trials)) / (1 + square / trials)
    half = _Z_95 / (1 + square / trials) * math.sqrt(rate * (1 - rate) / trials + square / (4 * trials**2))
    # Rounding errors must not exclude the rates 0 and 1.
    return (0.0 if successes == 0 else center - half), (1.0 if successes == trials else center + half)
