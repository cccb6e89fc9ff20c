"""Where in the room the things are that a sensor saw."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.ports.sensor import Image, Scan

Floats = NDArray[np.float64]

STRIDE = 2
"""Every second pixel in each direction is looked at: at 4 m and 320x240 that is one every 4 cm, less than a cell."""


@dataclass(slots=True)
class Lens:
    """The lines of sight of one depth camera's pixels, kept as long as its size and angle of view stay the same."""

    _key: tuple[int, int, float] = (0, 0, 0.0)
    _lines: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def lines(self, height: int, width: int, fovy_rad: float) -> Floats:
        """Line of sight of each ``STRIDE``-th pixel at depth 1 in the camera's axes, shape (n, 3), row by row."""
        if self._key != (height, width, fovy_rad):
            per_pixel = 2.0 * math.tan(fovy_rad / 2) / height
            across = (np.arange(0, width, STRIDE) + 0.5 - width / 2) * per_pixel
            up = (height / 2 - np.arange(0, height, STRIDE) - 0.5) * per_pixel
            grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
            self._lines = np.column_stack((grid, -np.ones(len(grid))))
            self._key = (height, width, fovy_rad)
        return self._lines


def depths(image: Image) -> Floats:
    """Depth of each ``STRIDE``-th pixel, shape (n,) [m], row by row; infinite where nothing is known."""
    if image.depth_m is None:
        raise ValueError("the picture has no depth")
    found = image.depth_m[::STRIDE, ::STRIDE].ravel().astype(np.float64)
    found[~(found > 0)] = math.inf
    return found


def points(image: Image, depth_m: Floats, lines: Floats) -> Floats:
    """Places in the room, shape (n, 3) [m].

    Args:
        image: Where the camera stands.
        depth_m: Finite, shape (n,) [m].
        lines: Their lines of sight, shape (n, 3).
    """
    found: Floats = image.position_m + (lines * depth_m[:, None]) @ image.rotation.T
    return found


def ends(scan: Scan) -> tuple[Floats, NDArray[np.bool_]]:
    """Where the beams of a level lidar end, shape (n, 2) [m], and whether they met something, shape (n,)."""
    met = np.isfinite(scan.range_m) & (scan.range_m >= scan.nearest_m) & (scan.range_m < scan.furthest_m)
    length = np.where(met, scan.range_m, scan.furthest_m)
    beams = np.column_stack((np.cos(scan.angle_rad), np.sin(scan.angle_rad)))
    ways = (beams * length[:, None]) @ scan.rotation[:2, :2].T
    return scan.position_m[:2] + ways, met


def pixels(image: Image, places_m: Floats, height: int, width: int) -> NDArray[np.int64]:
    """Row and column in a picture of the places that are in it, shape (m, 2).

    Args:
        image: Where the camera stands.
        places_m: Shape (n, 3) [m].
        height: Of the picture, in pixels.
        width: The same.
    """
    seen = (places_m - image.position_m) @ image.rotation
    seen = seen[seen[:, 2] < -1e-3]  # noqa: PLR2004 - what is in front
    per_pixel = 2.0 * math.tan(image.fovy_rad / 2) / height
    column = np.floor(seen[:, 0] / -seen[:, 2] / per_pixel + width / 2).astype(np.int64)
    row = np.floor(height / 2 - seen[:, 1] / -seen[:, 2] / per_pixel).astype(np.int64)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.column_stack((row[inside], column[inside]))
