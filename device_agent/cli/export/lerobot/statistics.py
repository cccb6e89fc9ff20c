"""Statistics of features, in the form that LeRobot uses to normalize them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_LEVELS = 256
"""Values of one colour of a pixel."""


def of_columns(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Minimum, maximum, mean, standard deviation, number and quantiles of each column of ``values``, shape (n, d)."""
    numbers = values.astype(np.float64)
    statistics: dict[str, list[Any]] = {
        "min": numbers.min(axis=0).tolist(),
        "max": numbers.max(axis=0).tolist(),
        "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(),
        "count": [len(numbers)],
    }
    return statistics | {_name(q): np.quantile(numbers, q, axis=0).tolist() for q in QUANTILES}


class ImageStatistics:
    """Counts how often each value of each colour occurs."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, _LEVELS), dtype=np.int64)
        self._images = 0

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Count an image, shape (height, width, 3)."""
        for colour in range(3):
            self._counts[colour] += np.bincount(pixels[..., colour].reshape(-1), minlength=_LEVELS)
        self._images += 1

    def merge(self, other: "ImageStatistics") -> None:
        """Add the counts of other images."""
        self._counts += other._counts  # noqa: SLF001 (the same class)
        self._images += other._images  # noqa: SLF001 (the same class)

    def result(self) -> dict[str, list[Any]]:
        """Statistics of each colour, shape (3, 1, 1), from 0 to 1; ``count`` is the number of images."""
        levels = np.arange(_LEVELS) / (_LEVELS - 1)
        total = self._counts.sum(axis=1)
        cumulated = np.cumsum(self._counts, axis=1)
        mean = self._counts @ levels / total
        values = {
            "min": levels[np.argmax(self._counts > 0, axis=1)],
            "max": levels[_LEVELS - 1 - np.argmax(self._counts[:, ::-1] > 0, axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(self._counts @ levels**2 / total - mean**2, 0.0)),
        } | {_name(q): levels[np.argmax(cumulated >= (q * total)[:, None], axis=1)] for q in QUANTILES}
        return {name: value.reshape(3, 1, 1).tolist() for name, value in values.items()} | {"count": [self._images]}


def _name(quantile: float) -> str:
    return f"q{round(quantile * 100):02d}"
