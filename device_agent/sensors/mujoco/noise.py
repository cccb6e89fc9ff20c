"""Sensor errors: constant offset, noise, lag and quantisation, seeded for reproducibility.

The figures are typical of the named parts, from their data sheets, and approximate.
"""

import math
import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseParameters:
    """Errors of one kind of sensor, in its own unit.

    Attributes:
        offset: Standard deviation of the constant error of one sensor; ``offset_share``: as a share of the value.
        jitter: Standard deviation between readings.
        lag_s: Time constant [s].
        step: Resolution.
        least: Smallest reading.
    """

    offset: float = 0.0
    offset_share: float = 0.0
    jitter: float = 0.0
    lag_s: float = 0.0
    step: float = 0.0
    least: float = -math.inf


NOISE = {
    # Sensirion SHT31: ±0.2 °C, repeatability 0.04 °C, 8 s with its housing.
    "temperature_c": NoiseParameters(offset=0.1, jitter=0.04, lag_s=8.0, step=0.01),
    # Sensirion SHT31: ±2 %RH, repeatability 0.08 %RH, 8 s.
    "humidity_percent": NoiseParameters(offset=1.0, jitter=0.08, lag_s=8.0, step=0.01, least=0.0),
    # Sensirion SCD30: ±(30 ppm + 3 %), repeatability 10 ppm, 20 s.
    "co2_ppm": NoiseParameters(offset=15.0, offset_share=0.015, jitter=10.0, lag_s=20.0, step=1.0, least=0.0),
    # ROHM BH1750: ±20 % from piece to piece, steps of 1 lx, a reading takes 0.12 s.
    "light_lux": NoiseParameters(offset_share=0.1, jitter=0.5, lag_s=0.12, step=1.0, least=0.0),
    # IEC 61672 class 2: ±1.4 dB at 1 kHz; time weighting F: 0.125 s.
    "sound_db": NoiseParameters(offset=0.7, jitter=0.3, lag_s=0.125, step=0.1, least=0.0),
}
"""Parameters by quantity."""


def generator(device: str, seed: int) -> np.random.Generator:
    """Random generator of one device; equal for equal name and seed."""
    return np.random.default_rng([zlib.crc32(device.encode()), seed])


class SensorNoise:
    """Adds errors to the readings of one sensor. Not thread-safe.

    Args:
        parameters: Parameters of its kind.
        random: Random generator.
    """

    def __init__(self, parameters: NoiseParameters, random: np.random.Generator) -> None:
        self._parameters = parameters
        self._random = random
        self._offset = float(random.normal(0.0, parameters.offset))
        self._factor = 1.0 + float(random.normal(0.0, parameters.offset_share))
        self._lagged: float | None = None
        self._at_s = 0.0

    def read(self, truth: float, now_s: float) -> float:
        """The reading for a true value.

        Args:
            truth: In the sensor's unit.
            now_s: Monotonic time [s].
        """
        parameters = self._parameters
        if self._lagged is None or not parameters.lag_s:
            self._lagged = truth
        else:
            share = 1.0 - math.exp(-max(0.0, now_s - self._at_s) / parameters.lag_s)
            self._lagged += (truth - self._lagged) * share
        self._at_s = now_s
        reading = self._lagged * self._factor + self._offset + float(self._random.normal(0.0, parameters.jitter))
        if parameters.step:
            reading = round(round(reading / parameters.step) * parameters.step, 6)
        return max(parameters.least, reading)
