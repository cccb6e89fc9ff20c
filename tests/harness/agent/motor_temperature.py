"""A joint's temperature [°C], second by second of its life: days, work, and cooling that fails."""

import math
import random
from collections.abc import Callable, Iterator

Temperature = Callable[[float], float]
DAY_S = 86_400.0
REST_C = 35.0


def daily(swing_c: float = 5.0) -> Temperature:
    """Warm days, cool nights."""
    return lambda at_s: REST_C + swing_c * math.sin(2 * math.pi * at_s / DAY_S)


def working(rise_c: float, settle_s: float, *, seed: int, days: float) -> Temperature:
    """Days, and work by chance: each spell warms it by up to ``rise_c``, at rest after some ``settle_s``."""
    chance = random.Random(seed)  # noqa: S311 (repeatable lives)
    base = daily()
    spells = [0.0]
    while spells[-1] < days * DAY_S:
        spells.append(spells[-1] + chance.uniform(1_200, 10_800))
    warmth, place, before_s = 0.0, 0, 0.0

    def at(at_s: float) -> float:
        nonlocal warmth, place, before_s
        while place + 1 < len(spells) and spells[place + 1] <= at_s:
            place += 1
        aim = rise_c if place % 2 else 0.0
        warmth += (aim - warmth) * -math.expm1(-(at_s - before_s) / settle_s)
        before_s = at_s
        return base(at_s) + warmth

    return at


def failing(healthy: Temperature, *, from_s: float, per_minute_c: float) -> Temperature:
    """As healthy, and from a moment on warming without end."""
    return lambda at_s: healthy(at_s) + max(0.0, at_s - from_s) / 60 * per_minute_c


def windows(truth: Temperature, *, hours: float, seed: int, noise_c: float = 0.3) -> Iterator[tuple[int, float]]:
    """Ten-second means: start [ms] and value."""
    chance = random.Random(seed)  # noqa: S311 (repeatable noise)
    for number in range(round(hours * 360)):
        yield 1_700_000_000_000 + number * 10_000, truth(number * 10.0) + chance.gauss(0, noise_c)
