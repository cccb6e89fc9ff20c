"""Simulated temperature of a joint [°C] over time: days, operation, and a cooling failure."""

import math
import random
from collections.abc import Callable, Iterator

Temperature = Callable[[float], float]
DAY_S = 86_400.0
REST_C = 35.0


def daily(swing_c: float = 5.0) -> Temperature:
    """A sine with a period of one day."""
    return lambda at_s: REST_C + swing_c * math.sin(2 * math.pi * at_s / DAY_S)


def working(rise_c: float, settle_s: float, *, seed: int, days: float) -> Temperature:
    """The daily sine, plus random periods of operation that warm the joint by up to ``rise_c``.

    Args:
        rise_c: Temperature rise in continuous operation [K].
        settle_s: Time constant of warming and cooling [s].
        seed: Random seed of the periods.
        days: Duration of the simulation.
    """
    chance = random.Random(seed)  # noqa: S311 (repeatable periods)
    base = daily()
    switches_s = [0.0]
    while switches_s[-1] < days * DAY_S:
        switches_s.append(switches_s[-1] + chance.uniform(1_200, 10_800))
    warmth_c, period, before_s = 0.0, 0, 0.0

    def at(at_s: float) -> float:
        nonlocal warmth_c, period, before_s
        while period + 1 < len(switches_s) and switches_s[period + 1] <= at_s:
            period += 1
        target_c = rise_c if period % 2 else 0.0
        warmth_c += (target_c - warmth_c) * -math.expm1(-(at_s - before_s) / settle_s)
        before_s = at_s
        return base(at_s) + warmth_c

    return at


def failing(healthy: Temperature, *, from_s: float, per_minute_c: float) -> Temperature:
    """``healthy``, with a constant additional warming from ``from_s`` on."""
    return lambda at_s: healthy(at_s) + max(0.0, at_s - from_s) / 60 * per_minute_c


def windows(temperature: Temperature, *, hours: float, seed: int, noise_c: float = 0.3) -> Iterator[tuple[int, float]]:
    """Noisy means over 10 s: start [ms] and value."""
    chance = random.Random(seed)  # noqa: S311 (repeatable noise)
    for number in range(round(hours * 360)):
        yield 1_700_000_000_000 + number * 10_000, temperature(number * 10.0) + chance.gauss(0, noise_c)
