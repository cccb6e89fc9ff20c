"""Light model of a simulated room: illuminance, and light intensities for the cameras.

Illuminance in the middle of the room at table height is E = E_day (b + (1 - b) blind opening) + E_lamp level, where b
is the share that closed blinds let through. E_day and E_lamp are room parameters. EN 12464-1 requires 500 lx in a
laboratory. The model's ``window`` and ``lamp…`` lights are dimmed accordingly.
"""

from typing import Any

import mujoco
import numpy as np

from device_agent.protocol.manifests.room import Room
from device_agent.simulation.room.openings import opening
from device_agent.simulation.world import World

PERIOD_S = 0.1
_THROUGH_BLINDS = 0.08
"""Share of daylight that passes light fabric; approximate."""
_LAMP, _BLINDS, _WINDOW = "lamp", "blinds", "window"
_UNLIT = 0.45
"""Colour of a lamp panel that is off, relative to one that is on."""


class Light:
    """``Process`` that computes ``light_lux`` and dims the model's lights and lamp panels.

    Args:
        room: Its light parameters.
        world: Receives the quantity.
    """

    def __init__(self, room: Room, world: World) -> None:
        self._parameters = room.climate
        self._world = world
        self._model: Any = None
        self._next_s = 0.0
        self._lamps: list[int] = []
        self._panels: list[int] = []
        self._window = -1
        self._full = np.zeros((0, 3))
        self._lit = np.zeros((0, 4))
        self._dimmed = (-1.0, -1.0)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Update the light from lamp and blinds."""
        if model is not self._model:
            self._resolve(model)
        if time_s < self._next_s:
            return
        self._next_s = time_s + PERIOD_S
        level = min(1.0, max(0.0, self._world.settings.get(_LAMP, 0.0)))
        day = _THROUGH_BLINDS + (1 - _THROUGH_BLINDS) * opening(model, data, _BLINDS, missing=1.0)
        self._world.set_quantities(
            {"light_lux": self._parameters.daylight_lux * day + self._parameters.lamp_lux * level}
        )
        if self._dimmed != (level, day):
            self._dim(model, level, day)

    def _dim(self, model: Any, level: float, day: float) -> None:
        self._dimmed = level, day
        for lamp in self._lamps:
            model.light_diffuse[lamp] = self._full[lamp] * level
        if self._window >= 0:
            model.light_diffuse[self._window] = self._full[self._window] * day
        for panel in self._panels:
            model.mat_rgba[panel, :3] = self._lit[panel, :3] * (_UNLIT + (1 - _UNLIT) * level)

    def _resolve(self, model: Any) -> None:
        self._model = model
        names = [str(model.light(light).name) for light in range(model.nlight)]
        self._lamps = [light for light, name in enumerate(names) if name.startswith(_LAMP)]
        self._window = names.index(_WINDOW) if _WINDOW in names else -1
        geoms = [int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, names[lamp])) for lamp in self._lamps]
        self._panels = sorted({int(model.geom_matid[geom]) for geom in geoms if geom >= 0} - {-1})
        self._full, self._lit = model.light_diffuse.copy(), model.mat_rgba.copy()
