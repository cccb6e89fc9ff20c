"""Distances from ``sensor_msgs/LaserScan`` and ``PointCloud2``."""

import math
from collections.abc import Mapping

import msgspec
import numpy as np

from device_agent.ports.sensor import Depths, Floats

MAX_BEAMS = 1440
MAX_POINTS = 2000
"""Larger scans and clouds are reduced by a whole factor."""
_SECTORS = 8
_FLOAT32 = 7


class LaserScan(msgspec.Struct, frozen=True):
    """``sensor_msgs/LaserScan``. Ranges that are not finite arrive as ``null``."""

    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: tuple[float | None, ...]


class PointField(msgspec.Struct, frozen=True):
    """``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int


class PointCloud2(msgspec.Struct, frozen=True):
    """``sensor_msgs/PointCloud2``. The data are Base64 in JSON."""

    height: int
    width: int
    fields: tuple[PointField, ...]
    point_step: int
    row_step: int
    data: bytes
    is_bigendian: bool = False


def beams(scan: LaserScan) -> tuple[Floats, Floats]:
    """Angle [rad] and range [m] of each beam, at most ``MAX_BEAMS``; ``inf`` for a range outside the limits.

    Raises:
        ValueError: The scan is empty, or its limits are wrong.
    """
    values = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    if not scan.ranges or not all(map(math.isfinite, values)) or not 0 <= scan.range_min < scan.range_max:
        raise ValueError("a LaserScan has no ranges or invalid limits")
    every = math.ceil(len(scan.ranges) / MAX_BEAMS)
    ranges_m: Floats = np.array([math.inf if each is None else each for each in scan.ranges[::every]], np.float64)
    valid = (ranges_m >= scan.range_min) & (ranges_m <= scan.range_max) & (ranges_m > 0)
    angles_rad: Floats = np.asarray(
        scan.angle_min + np.arange(len(ranges_m)) * (every * scan.angle_increment), np.float64
    )
    ranges_m[~valid] = np.inf
    return angles_rad, ranges_m


def sectors(scan: LaserScan) -> Mapping[str, float]:
    """Smallest range in each of eight sectors as ``range_m.0`` …, from the first beam; the maximum without one."""
    _, ranges_m = beams(scan)
    parts = np.array_split(ranges_m, min(_SECTORS, len(ranges_m)))
    return {f"range_m.{index}": round(min(float(part.min()), scan.range_max), 4) for index, part in enumerate(parts)}


def points(cloud: PointCloud2) -> Depths:
    """Finite points of a cloud with x, y and z as float32, at most ``MAX_POINTS``, shape (n, 3) [m].

    Raises:
        ValueError: Other fields, or data of another size.
    """
    offsets = {field.name: field.offset for field in cloud.fields if field.datatype == _FLOAT32}
    missing = [name for name in "xyz" if name not in offsets]
    if missing:
        raise ValueError(f"a PointCloud2 has no field '{missing[0]}' of type float32")
    used = [offsets[name] for name in "xyz"]
    fits = min(used) >= 0 and max(used) + 4 <= cloud.point_step and cloud.width * cloud.point_step <= cloud.row_step
    if not fits or cloud.width < 1 or cloud.height < 1 or len(cloud.data) < cloud.height * cloud.row_step:
        raise ValueError(f"a PointCloud2 of {cloud.width} x {cloud.height} points has {len(cloud.data)} bytes")
    dtype, strides = np.dtype(">f4" if cloud.is_bigendian else "<f4"), (cloud.row_step, cloud.point_step)
    columns = [
        np.ndarray((cloud.height, cloud.width), dtype, cloud.data, offset=offset, strides=strides).ravel()
        for offset in used
    ]
    found = np.stack(columns, axis=1).astype(np.float32)
    found = found[np.isfinite(found).all(axis=1)]
    return np.asarray(found[:: max(1, math.ceil(len(found) / MAX_POINTS))])
