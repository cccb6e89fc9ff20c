"""A-weighted sound level of a simulated room at its microphone (site ``sound``).

Levels add by energy, L = 10 lg Σ 10^(Li/10), over the quiet room, footsteps, motors and reported sounds such as
speech. A source of level L₁ at 1 m has L_w = L₁ + 10 lg 4π and is received by the direct and the diffuse field,
L = L_w + 10 lg (1/(4π r²) + 4/A), with A the room's absorption by Sabine (Kuttruff, Room Acoustics). ISO 9921 gives
60 dB at 1 m for normal speech; footsteps and motors are approximate.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from device_agent.protocol.manifests.room import Room
from device_agent.simulation.room.pedestrian import Pedestrian
from device_agent.simulation.world import World

PERIOD_S = 0.1
_FOOTSTEPS_DB = 48.0
"""At 1 m, for walking at 1 m/s; add 20 lg of the speed."""
_MOTORS_DB = 36.0
"""At 1 m, for a sum of joint speeds of 1 rad/s; add 10 lg of the sum."""
_ABSORPTION_M2 = 14.0
"""Of a furnished room of 30 m² with a reverberation time of 0.5 s."""
_SLOW_M_S, _SLOW_RAD_S = 0.05, 0.02
_NEAR_M = 0.3
_MICROPHONE = "sound"
_ROBOT = "/"


class Sound:
    """``Process`` that computes ``sound_db``.

    Args:
        room: Its background level.
        world: Receives the quantity.
        people: Pedestrians whose footsteps are audible.
    """

    def __init__(self, room: Room, world: World, people: Sequence[Pedestrian]) -> None:
        self._quiet_db = room.climate.quiet_db
        self._world = world
        self._people = people
        self._model: Any = None
        self._next_s = 0.0
        self._microphone = -1
        self._robots: list[tuple[int, Any]] = []  # (root body, its joints' degrees of freedom)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Update the sound level."""
        if model is not self._model:
            self._resolve(model)
        if time_s < self._next_s:
            return
        self._next_s = time_s + PERIOD_S
        microphone_m = data.site_xpos[self._microphone] if self._microphone >= 0 else np.zeros(3)
        energy = _energy(self._quiet_db)
        for person in self._people:
            if person.speed_m_s > _SLOW_M_S:
                level_db = _FOOTSTEPS_DB + 20 * math.log10(person.speed_m_s)
                energy += _energy(received_db(level_db, math.dist((*person.position_m, 0.0), microphone_m)))
        for root, dofs in self._robots:
            turning = float(np.abs(data.qvel[dofs]).sum())
            if turning > _SLOW_RAD_S:
                level_db = _MOTORS_DB + 10 * math.log10(turning)
                energy += _energy(received_db(level_db, math.dist(data.xpos[root], microphone_m)))
        for name, (level_db, until_s) in list(self._world.sounds.items()):
            if time_s <= until_s:
                energy += _energy(received_db(level_db, self._away(model, data, name, microphone_m)))
        self._world.set_quantities({"sound_db": 10 * math.log10(energy)})

    def _away(self, model: Any, data: Any, name: str, microphone_m: Any) -> float:
        """Distance to the robot of this name; 1 m for other sources."""
        for root, _ in self._robots:
            if str(model.body(root).name).startswith(f"{name}{_ROBOT}"):
                return math.dist(data.xpos[root], microphone_m)
        return 1.0

    def _resolve(self, model: Any) -> None:
        self._model = model
        self._microphone = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, _MICROPHONE))
        root_of = model.body_rootid[model.dof_bodyid]
        free = model.jnt_type[model.dof_jntid] == int(mujoco.mjtJoint.mjJNT_FREE)
        self._robots = [
            (int(root), np.flatnonzero((root_of == root) & ~free))
            for root in np.unique(root_of)
            if _ROBOT in str(model.body(root).name)
        ]


def received_db(level_db: float, away_m: float) -> float:
    """Received level of a source with this level at 1 m in the open."""
    direct = 1 / (4 * math.pi * max(away_m, _NEAR_M) ** 2)
    return level_db + 10 * math.log10(4 * math.pi) + 10 * math.log10(direct + 4 / _ABSORPTION_M2)


def _energy(level_db: float) -> float:
    return float(10 ** (level_db / 10))
