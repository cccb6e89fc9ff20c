"""Projects pixels and beams to points in the room."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.ports.sensor import Image, Scan

Floats = NDArray[np.float64]

STRIDE = 2
"""Every second pixel in each direction is used: 4 cm apart at 4 m and 320x240, less than a cell."""


@dataclass(slots=True)
class Lens:
    """Pixel rays of one depth camera, cached for its image size and field of view."""

    _key: tuple[int, int, float] = (0, 0, 0.0)
    _lines: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def lines(self, height: int, width: int, fovy_rad: float) -> Floats:
        """Ray of each ``STRIDE``-th pixel at depth 1 in the camera's axes, shape (n, 3), row by row."""
        if self._key != (height, width, fovy_rad):
            per_pixel = 2.0 * math.tan(fovy_rad / 2) / height
            across = (np.arange(0, width, STRIDE) + 0.5 - width / 2) * per_pixel
            up = (height / 2 - np.arange(0, height, STRIDE) - 0.5) * per_pixel
            grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
            self._lines = np.column_stack((grid, -np.ones(len(grid))))
            self._key = (height, width, fovy_rad)
        return self._lines


def depths(image: Image) -> Floats:
    """Depth of each ``STRIDE``-th pixel, shape (n,) [m], row by row; infinite without a reading."""
    if image.depth_m is None:
        raise ValueError("the image has no depth")
    result = image.depth_m[::STRIDE, ::STRIDE].ravel().astype(np.float64)
    result[~(result > 0)] = math.inf
    return result


def points(image: Image, depth_m: Floats, lines: Floats) -> Floats:
    """Points in the room, shape (n, 3) [m].

    Args:
        image: With the camera's pose.
        depth_m: Finite, shape (n,) [m].
        lines: Their rays, shape (n, 3).
    """
    result: Floats = image.position_m + (lines * depth_m[:, None]) @ image.rotation.T
    return result


def ends(scan: Scan) -> tuple[Floats, NDArray[np.bool_]]:
    """End points of a level lidar's beams, shape (n, 2) [m], and whether they hit something, shape (n,)."""
    hit = np.isfinite(scan.range_m) & (scan.range_m >= scan.nearest_m) & (scan.range_m < scan.furthest_m)
    length = np.where(hit, scan.range_m, scan.furthest_m)
    beams = np.column_stack((np.cos(scan.angle_rad), np.sin(scan.angle_rad)))
    offsets = (beams * length[:, None]) @ scan.rotation[:2, :2].T
    return scan.position_m[:2] + offsets, hit


def pixels(image: Image, points_m: Floats, height: int, width: int) -> NDArray[np.int64]:
    """Row and column of the points that are inside an image, shape (m, 2).

    Args:
        image: With the camera's pose.
        points_m: Shape (n, 3) [m].
        height: Image height [px].
        width: Image width [px].
    """
    in_camera = (points_m - image.position_m) @ image.rotation
    in_camera = in_camera[in_camera[:, 2] < -1e-3]  # noqa: PLR2004 - in front of the camera
    per_pixel = 2.0 * math.tan(image.fovy_rad / 2) / height
    column = np.floor(in_camera[:, 0] / -in_camera[:, 2] / per_pixel + width / 2).astype(np.int64)
    row = np.floor(height / 2 - in_camera[:, 1] / -in_camera[:, 2] / per_pixel).astype(np.int64)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.column_stack((row[inside], column[inside]))
