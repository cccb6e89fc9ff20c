"""A single-plane lidar."""

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.sensor import Capture, Floats, Frame, Scan, Values
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol import camera_frames
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.frames import declared_camera
from device_agent.sensors.mujoco.base import SimulatedSensor
from device_agent.sensors.mujoco.noise import generator

STREAM = "range"
_BEAMS = 360
_NEAREST_M, _FURTHEST_M = 0.15, 12.0
_LEAST_M, _SHARE = 0.005, 0.01
"""Standard deviation: 1 % of the distance, at least 5 mm (SLAMTEC RPLIDAR A1: "below 1 %"; approximate)."""
_SECTORS = 8


class Lidar(SimulatedSensor):
    """Beams in the x-y plane of a site; its own body is invisible to it.

    Stream ``range``: the smallest distance in each of eight sectors, ``range_m.0`` to the left of the site's x axis;
    ``furthest_m`` without a hit. Frames of the kind ``scan`` and capture ``scan``: all beams, JSON.

    Options: ``site``, its name in the model (default: the device's name); ``beams``; ``nearest_m``, ``furthest_m``.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {
        "site": str,
        "beams": int,
        "nearest_m": (int, float),
        "furthest_m": (int, float),
    }

    FRAMES = (camera_frames.SCAN,)

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        self._name: str = self.option("site", device.name)
        self._nearest_m = float(self.option("nearest_m", _NEAREST_M))
        self._furthest_m = float(self.option("furthest_m", _FURTHEST_M))
        self._random = generator(device.name, self.option("seed", 0))
        beams = max(_SECTORS, self.option("beams", _BEAMS))
        self._angle_rad: Floats = np.arange(beams) * (2 * math.pi / beams)
        self._beams: Floats = np.stack((np.cos(self._angle_rad), np.sin(self._angle_rad), np.zeros(beams)), axis=1)
        self._site = 0
        self._body = -1

    def on_connect(self, model: Any) -> None:
        """See ``SimulatedSensor``."""
        self._site = self.find(model, "site", self._name)
        body = int(model.site_bodyid[self._site])
        # A site on the world body excludes nothing: the walls belong to that body.
        self._body = body or -1

    def raw(self) -> Scan:
        """See ``RoomDriver``."""
        self.require()
        count = len(self._angle_rad)
        distance_m, geoms = np.empty(count), np.empty(count, dtype=np.int32)
        with self.view.current() as (data, taken_s):
            position_m = data.site_xpos[self._site].copy()
            rotation = data.site_xmat[self._site].reshape(3, 3).copy()
            beams = np.ascontiguousarray(self._beams @ rotation.T).ravel()
            mujoco.mj_multiRay(
                self._world.model, data, position_m, beams, None, True, self._body, geoms, distance_m, None, count,
                self._furthest_m,
            )  # fmt: skip
            noise = self._random.normal(0.0, 1.0, count)
        valid = (geoms >= 0) & (distance_m >= self._nearest_m) & (distance_m <= self._furthest_m)
        measured_m = distance_m + noise * np.maximum(_LEAST_M, _SHARE * distance_m)
        return Scan(
            taken_s=taken_s,
            position_m=position_m,
            rotation=rotation,
            angle_rad=self._angle_rad.copy(),
            range_m=np.where(valid, np.maximum(measured_m, self._nearest_m), np.inf),
            nearest_m=self._nearest_m,
            furthest_m=self._furthest_m,
        )

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if stream != STREAM:
            return super().read(stream)
        nearest = (float(sector.min()) for sector in np.array_split(self.raw().range_m, _SECTORS))
        return {f"range_m.{index}": round(min(each, self._furthest_m), 4) for index, each in enumerate(nearest)}

    def frame(self, camera: str) -> Frame:
        """See ``ports.sensor.Camera``."""
        declared_camera(self._device, camera)
        return self.raw().frame()

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        if name not in self._device.captures:
            return super().capture(name)
        return self.raw().capture()
