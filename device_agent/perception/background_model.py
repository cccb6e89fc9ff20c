"""What the room looks like when nobody is in it: how far each beam and each pixel then sees.

It is taken once, without robots and while people may walk through: what stands in the way now and then is not
furniture. Who comes into the room later is what stands nearer than the survey says.
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
"""How much nearer than in the survey something is that was not there [m], besides how far the sensor errs:"""
BEAM_ERROR, PIXEL_ERROR_1_M = 0.04, 0.009
"""four times what lidars err, of the distance, and what depth cameras err, of its square [1/m]: structured light errs
by 0.0019 z² (Nguyen, Izadi and Lovell, 2012), others by less."""
SHARE = 80.0
"""Percentile of what was seen that counts: who stands in the way a fifth of the time disappears."""
POSE_M = 0.005
"""A sensor that is moved by more than that sees another room."""
_FAR = np.float16(1000.0)
"""Stands in the file for nothing within reach."""


class SurveyError(Exception):
    """The survey cannot be used. Its text says what to do."""


@dataclass(frozen=True, slots=True)
class _View:
    """What one sensor saw of the empty room.

    Attributes:
        pose: Its position and rotation, shape (12,).
        far_m: How far each beam or pixel saw, shape (n,) [m]; infinite where nothing was within reach.
    """

    pose: Floats
    far_m: Floats


@dataclass(slots=True)
class BackgroundModel:
    """The empty room, by sensor. It is learned with ``look`` and ``settle``, or read from a file."""

    _views: dict[str, _View] = field(default_factory=dict)
    _looks: dict[str, list[_View]] = field(default_factory=dict)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Whose view it knows."""
        return tuple(sorted(self._views))

    def look(self, sensor: str, raw: Scan | Image) -> None:
        """Remember a look, until ``settle``."""
        self._looks.setdefault(sensor, []).append(_View(_pose(raw), _far(raw)))

    def settle(self) -> None:
        """Make the survey out of all looks since the last time.

        Raises:
            SurveyError: A sensor moved meanwhile.
        """
        for sensor, looks in self._looks.items():
            if any(not _same(look.pose, looks[0].pose) for look in looks):
                raise SurveyError(f"'{sensor}' was moved while the room was surveyed; let it stand still")
            far = np.percentile(np.stack([look.far_m for look in looks]), SHARE, axis=0, method="higher")
            self._views[sensor] = _View(looks[0].pose, far)
        self._looks.clear()

    def nearer(self, sensor: str, raw: Scan | Image) -> NDArray[np.bool_] | None:
        """Which beams or pixels see something that was not there, shape (n,); ``None`` for an unknown view."""
        view = self._views.get(sensor)
        if view is None or not _same(view.pose, _pose(raw)):
            return None
        now = _far(raw)
        if now.shape != view.far_m.shape:
            return None
        found: NDArray[np.bool_] = now + _slack(raw, now) < view.far_m
        return found

    def differs(self, sensor: str, raw: Scan | Image) -> float:
        """The share of beams or pixels that see something else than in the survey, 0…1; 1 for an unknown view."""
        view = self._views.get(sensor)
        now = _far(raw)
        if view is None or now.shape != view.far_m.shape or not _same(view.pose, _pose(raw)):
            return 1.0
        near, far = np.minimum(now, view.far_m), np.maximum(now, view.far_m)
        return float(np.mean(near + _slack(raw, near) < far))

    # ------------------------------------------------------------ as a file

    def content(self) -> bytes:
        """The survey as a file."""
        arrays: dict[str, NDArray[np.float16] | Floats] = {}
        for sensor, view in sorted(self._views.items()):
            arrays[f"{sensor}.pose"] = view.pose
            arrays[f"{sensor}.far_m"] = np.where(np.isfinite(view.far_m), view.far_m, _FAR).astype(np.float16)
        file = io.BytesIO()
        np.savez_compressed(file, allow_pickle=False, **arrays)
        return file.getvalue()

    @classmethod
    def read(cls, content: bytes) -> "BackgroundModel":
        """A survey from its file.

        Raises:
            SurveyError: It is none.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                return cls._of({name: np.asarray(file[name], dtype=np.float64) for name in file.files})
        except (ValueError, OSError, KeyError, EOFError) as error:
            raise SurveyError(f"this is no survey of a room ({error}); take a new one") from error

    @classmethod
    def _of(cls, arrays: Mapping[str, Floats]) -> "BackgroundModel":
        sensors = {name.rpartition(".")[0] for name in arrays}
        found = {}
        for sensor in sensors:
            far = arrays[f"{sensor}.far_m"]
            found[sensor] = _View(arrays[f"{sensor}.pose"], np.where(far < float(_FAR), far, math.inf))
        return cls(found)


def _far(raw: Scan | Image) -> Floats:
    if isinstance(raw, Image):
        return projection.depths(raw)
    met = np.isfinite(raw.range_m) & (raw.range_m >= raw.nearest_m) & (raw.range_m < raw.furthest_m)
    return np.where(met, raw.range_m, math.inf)


def _slack(raw: Scan | Image, far_m: Floats) -> Floats:
    """By how much a distance may differ for no reason, shape (n,) [m]."""
    error = BEAM_ERROR * far_m if isinstance(raw, Scan) else PIXEL_ERROR_1_M * far_m**2
    found: Floats = NEARER_M + error
    return found


def _pose(raw: Scan | Image) -> Floats:
    return np.concatenate((np.asarray(raw.position_m, dtype=np.float64), np.ravel(raw.rotation)))


def _same(one: Floats, other: Floats) -> bool:
    return bool(np.all(np.abs(one - other) < POSE_M))
