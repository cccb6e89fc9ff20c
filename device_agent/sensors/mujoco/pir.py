"""A passive infrared detector: detects warm bodies that move across its view."""

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from device_agent.ports.sensor import Floats, Values
from device_agent.ports.simulation import SimulatedWorld
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.mujoco.base import SimulatedSensor

STREAM = "motion"
_FURTHEST_M = 7.0
_CONE_RAD = math.radians(110)
_HOLD_S = 2.0
_ACROSS_RAD_S = math.radians(4)
"""Slower motion across the view, or relative approach, is not detected."""
_HOUSING_M = 0.1
"""Distance at which rays start, outside the detector's own housing."""
_INTERVAL_S = 0.2
"""Shortest interval over which motion is measured."""


class Pir(SimulatedSensor):
    """Detects along the x axis of a site. Stream ``motion``: ``present``, held for a time after each motion.

    Typical of small modules (HC-SR501: 7 m, 110°), approximate. Warm bodies are named; by default people are warm,
    furniture and robots are not. Bodies behind obstacles are not detected.

    Options: ``site``, its name in the room's model (default: the device's name); ``warm``, name prefixes of warm bodies
    (``["person"]``); ``furthest_m``, ``cone_rad``, ``hold_s``.
    """

    OPTIONS: Mapping[str, type | tuple[type, ...]] = {
        "site": str,
        "warm": list,
        "furthest_m": (int, float),
        "cone_rad": (int, float),
        "hold_s": (int, float),
    }

    def __init__(self, device: RoomDeviceManifest, world: SimulatedWorld) -> None:
        super().__init__(device, world)
        self._name: str = self.option("site", device.name)
        self._warm: tuple[str, ...] = tuple(map(str, self.option("warm", ["person"])))
        self._furthest_m = float(self.option("furthest_m", _FURTHEST_M))
        self._least_cosine = math.cos(float(self.option("cone_rad", _CONE_RAD)) / 2)
        self._hold_s = float(self.option("hold_s", _HOLD_S))
        self._site = 0
        self._own = -1
        self._bodies: list[int] = []
        self._before: dict[int, tuple[float, Floats]] = {}
        self._moved_s = -math.inf

    def on_connect(self, model: Any) -> None:
        """See ``SimulatedSensor``."""
        self._site = self.find(model, "site", self._name)
        self._own = int(model.site_bodyid[self._site]) or -1
        names = (model.body(index).name for index in range(model.nbody))
        self._bodies = [index for index, name in enumerate(names) if name.startswith(self._warm)]
        self._before.clear()
        self._moved_s = -math.inf

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        if stream != STREAM:
            return super().read(stream)
        self.require()
        with self.view.current() as (data, _):
            now_s = float(data.time)
            for body in self._bodies:
                offset = self._visible(data, body)
                if offset is None:
                    self._before.pop(body, None)
                elif self._moves(body, offset, now_s):
                    self._moved_s = now_s
        return {"present": now_s - self._moved_s < self._hold_s}

    def _visible(self, data: Any, body: int) -> Floats | None:
        """Vector to a visible body's centre of mass [m]."""
        origin, matrix = data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3)
        offset: Floats = data.xipos[body] - origin
        distance_m = float(np.linalg.norm(offset))
        if not 0 < distance_m <= self._furthest_m or float(offset @ matrix[:, 0]) < self._least_cosine * distance_m:
            return None
        direction, geom = offset / distance_m, np.full(1, -1, dtype=np.int32)
        start = origin + direction * _HOUSING_M
        mujoco.mj_ray(self._world.model, data, start, direction, None, True, self._own, geom, None)
        if geom[0] >= 0 and int(self._world.model.geom_bodyid[geom[0]]) not in self._bodies:
            return None
        return offset

    def _moves(self, body: int, offset: Floats, now_s: float) -> bool:
        before_s, before = self._before.setdefault(body, (now_s, offset))
        elapsed_s = now_s - before_s
        if elapsed_s < _INTERVAL_S:
            return False
        self._before[body] = (now_s, offset)
        return float(np.linalg.norm(offset - before)) > _ACROSS_RAD_S * elapsed_s * float(np.linalg.norm(offset))
