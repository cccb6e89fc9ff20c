"""How real sensors err: a fixed offset, a jitter, a lag, steps. Seeded, so that the same room gives the same errors.

The figures are typical of the parts that they name, from those parts' data sheets, and approximate.
"""

import math
import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Of one kind of sensor, in its own unit.

    Attributes:
        offset: Standard deviation of what this one piece is wrong by for all its life; ``offset_share``: of the value.
        jitter: Standard deviation from one reading to the next.
        lag_s: Time in which it follows 63 % of a step [s].
        step: Smallest difference that it tells.
        least: The lowest value that it tells.
    """

    offset: float = 0.0
    offset_share: float = 0.0
    jitter: float = 0.0
    lag_s: float = 0.0
    step: float = 0.0
    least: float = -math.inf


ERRORS = {
    # Sensirion SHT31: ±0.2 °C, repeatability 0.04 °C, 8 s with its housing.
    "temperature_c": Errors(offset=0.1, jitter=0.04, lag_s=8.0, step=0.01),
    # Sensirion SHT31: ±2 %RH, repeatability 0.08 %RH, 8 s.
    "humidity_percent": Errors(offset=1.0, jitter=0.08, lag_s=8.0, step=0.01, least=0.0),
    # Sensirion SCD30: ±(30 ppm + 3 %), repeatability 10 ppm, 20 s.
    "co2_ppm": Errors(offset=15.0, offset_share=0.015, jitter=10.0, lag_s=20.0, step=1.0, least=0.0),
    # ROHM BH1750: ±20 % from piece to piece, steps of 1 lx, a reading takes 0.12 s.
    "light_lux": Errors(offset_share=0.1, jitter=0.5, lag_s=0.12, step=1.0, least=0.0),
    # IEC 61672 class 2: ±1.4 dB at 1 kHz; time weighting F: 0.125 s.
    "sound_db": Errors(offset=0.7, jitter=0.3, lag_s=0.125, step=0.1, least=0.0),
}
"""By the quantity that is read."""


def generator(device: str, seed: int) -> np.random.Generator:
    """Chance of one device: the same for the same name and seed."""
    return np.random.default_rng([zlib.crc32(device.encode()), seed])


class Probe:
    """One piece of a kind of sensor. Not thread-safe.

    Args:
        errors: Of its kind.
        chance: Where its own come from.
    """

    def __init__(self, errors: Errors, chance: np.random.Generator) -> None:
        self._errors = errors
        self._chance = chance
        self._offset = float(chance.normal(0.0, errors.offset))
        self._factor = 1.0 + float(chance.normal(0.0, errors.offset_share))
        self._follows: float | None = None
        self._at_s = 0.0

    def read(self, truth: float, now_s: float) -> float:
        """What it tells while the truth is this.

        Args:
            truth: In the sensor's unit.
            now_s: A clock that only rises [s].
        """
        errors = self._errors
        if self._follows is None or not errors.lag_s:
            self._follows = truth
        else:
            share = 1.0 - math.exp(-max(0.0, now_s - self._at_s) / errors.lag_s)
            self._follows += (truth - self._follows) * share
        self._at_s = now_s
        told = self._follows * self._factor + self._offset + float(self._chance.normal(0.0, errors.jitter))
        if errors.step:
            told = round(round(told / errors.step) * errors.step, 6)
        return max(errors.least, told)
