"""The view of the empty room: how far each beam and each pixel of each sensor reaches.

It is recorded without robots; people may walk through, because short occlusions are filtered out. Anything nearer than
the background is an object that has entered the room.
"""

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from device_agent.perception import projection
from device_agent.ports.sensor import Image, Scan

Floats = NDArray[np.float64]

NEARER_M = 0.08
"""A reading is foreground if it is nearer by this [m] plus the sensor's error:"""
BEAM_ERROR, PIXEL_ERROR_1_M = 0.04, 0.009
"""four times the error of lidars, relative to the distance, and of depth cameras, relative to its square [1/m]. The
error of structured light is 0.0019 z² (Nguyen, Izadi and Lovell, 2012), others have less."""
SHARE = 80.0
"""Percentile of the samples that counts; an occlusion of up to a fifth of the time disappears."""
POSE_M = 0.005
"""A sensor that has moved further than this has a different view."""
_FAR = np.float16(1000.0)
"""Stored in the file if there was no reading."""


class BackgroundModelError(Exception):
    """The background model cannot be used. The message names the remedy."""


@dataclass(frozen=True, slots=True)
class _View:
    """One sensor's view of the empty room.

    Attributes:
        pose: Its position and rotation, shape (12,).
        far_m: Distance of each beam or pixel, shape (n,) [m]; infinite without a reading.
    """

    pose: Floats
    far_m: Floats


@dataclass(slots=True)
class BackgroundModel:
    """The empty room by sensor. Build it with ``add`` and ``fit``, or load it with ``from_bytes``."""

    _views: dict[str, _View] = field(default_factory=dict)
    _samples: dict[str, list[_View]] = field(default_factory=dict)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the known sensors."""
        return tuple(sorted(self._views))

    def add(self, sensor: str, raw: Scan | Image) -> None:
        """Add a sample for ``fit``."""
        self._samples.setdefault(sensor, []).append(_View(_pose(raw), _far(raw)))

    def fit(self) -> None:
        """Compute the views from all samples since the last call.

        Raises:
            BackgroundModelError: A sensor moved in between.
        """
        for sensor, samples in self._samples.items():
            if any(not _is_same_pose(add.pose, samples[0].pose) for add in samples):
                raise BackgroundModelError(f"'{sensor}' moved during the survey; keep it still and repeat")
            far = np.percentile(np.stack([add.far_m for add in samples]), SHARE, axis=0, method="higher")
            self._views[sensor] = _View(samples[0].pose, far)
        self._samples.clear()

    def foreground(self, sensor: str, raw: Scan | Image) -> NDArray[np.bool_] | None:
        """Mask of foreground beams or pixels, shape (n,); ``None`` for an unknown view."""
        view = self._views.get(sensor)
        if view is None or not _is_same_pose(view.pose, _pose(raw)):
            return None
        current = _far(raw)
        if current.shape != view.far_m.shape:
            return None
        result: NDArray[np.bool_] = current + _tolerance_m(raw, current) < view.far_m
        return result

    def change_share(self, sensor: str, raw: Scan | Image) -> float:
        """Share of beams or pixels that differ from the background, 0…1; 1 for an unknown view."""
        view = self._views.get(sensor)
        current = _far(raw)
        if view is None or current.shape != view.far_m.shape or not _is_same_pose(view.pose, _pose(raw)):
            return 1.0
        near, far = np.minimum(current, view.far_m), np.maximum(current, view.far_m)
        return float(np.mean(near + _tolerance_m(raw, near) < far))

    # ------------------------------------------------------------ serialization

    def to_bytes(self) -> bytes:
        """The file content."""
        arrays: dict[str, NDArray[np.float16] | Floats] = {}
        for sensor, view in sorted(self._views.items()):
            arrays[f"{sensor}.pose"] = view.pose
            arrays[f"{sensor}.far_m"] = np.where(np.isfinite(view.far_m), view.far_m, _FAR).astype(np.float16)
        file = io.BytesIO()
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> "BackgroundModel":
        """Load a background model.

        Raises:
            BackgroundModelError: The content is invalid.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                return cls._of({name: np.asarray(file[name], dtype=np.float64) for name in file.files})
        except (ValueError, OSError, KeyError, EOFError) as error:
            raise BackgroundModelError(f"this is not a survey of a room ({error}); take a new one") from error

    @classmethod
    def _of(cls, arrays: Mapping[str, Floats]) -> "BackgroundModel":
        sensors = {name.rpartition(".")[0] for name in arrays}
        result = {}
        for sensor in sensors:
            far = arrays[f"{sensor}.far_m"]
            result[sensor] = _View(arrays[f"{sensor}.pose"], np.where(far < float(_FAR), far, math.inf))
        return cls(result)


def _far(raw: Scan | Image) -> Floats:
    if isinstance(raw, Image):
        return projection.depths(raw)
    valid = np.isfinite(raw.range_m) & (raw.range_m >= raw.nearest_m) & (raw.range_m < raw.furthest_m)
    return np.where(valid, raw.range_m, math.inf)


def _tolerance_m(raw: Scan | Image, far_m: Floats) -> Floats:
    """Largest insignificant difference of a distance, shape (n,) [m]."""
    error = BEAM_ERROR * far_m if isinstance(raw, Scan) else PIXEL_ERROR_1_M * far_m**2
    result: Floats = NEARER_M + error
    return result


def _pose(raw: Scan | Image) -> Floats:
    return np.concatenate((np.asarray(raw.position_m, dtype=np.float64), np.ravel(raw.rotation)))


def _is_same_pose(first: Floats, second: Floats) -> bool:
    return bool(np.all(np.abs(first - second) < POSE_M))
