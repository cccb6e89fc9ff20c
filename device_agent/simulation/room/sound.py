"""Sound level of a simulated room, A-weighted, where its microphone is (site ``sound``).

Levels add by energy, L = 10 lg Σ 10^(Li/10), over the quiet room, footsteps, motors and what the world was told of, as
speech. A source of level L₁ a metre away has L_w = L₁ + 10 lg 4π and is heard by the direct and the diffuse field,
L = L_w + 10 lg (1/(4π r²) + 4/A), with A the room's absorption by Sabine (Kuttruff, Room Acoustics). ISO 9921 gives
normal speech 60 dB a metre away; footsteps and motors are of the size that one measures, approximate.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from device_agent.protocol.manifests.room import Room
from device_agent.simulation.room.pedestrian import Walker
from device_agent.simulation.world import World

PERIOD_S = 0.1
_FOOTSTEPS_DB = 48.0
"""A metre away, of a walk at 1 m/s; 20 lg of the speed more."""
_MOTORS_DB = 36.0
"""A metre away, of a robot whose joints turn by 1 rad/s in sum; 10 lg of the sum more."""
_ABSORPTION_M2 = 14.0
"""Of a furnished room of thirty square metres: reverberation of 0.5 s."""
_SLOW_M_S, _SLOW_RAD_S = 0.05, 0.02
_NEAR_M = 0.3
_MICROPHONE = "sound"
_ROBOT = "/"


class Sound:
    """A ``Process`` of a ``World``; tells ``sound_db``.

    Args:
        room: How quiet it is.
        world: Whose quantities it tells.
        people: Whose steps are heard.
    """

    def __init__(self, room: Room, world: World, people: Sequence[Walker]) -> None:
        self._quiet_db = room.climate.quiet_db
        self._world = world
        self._people = people
        self._model: Any = None
        self._next_s = 0.0
        self._microphone = -1
        self._robots: list[tuple[int, Any]] = []  # (root body, its joints' degrees of freedom)

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Listen."""
        if model is not self._model:
            self._resolve(model)
        if time_s < self._next_s:
            return
        self._next_s = time_s + PERIOD_S
        here = data.site_xpos[self._microphone] if self._microphone >= 0 else np.zeros(3)
        energy = _energy(self._quiet_db)
        for person in self._people:
            if person.speed_m_s > _SLOW_M_S:
                level_db = _FOOTSTEPS_DB + 20 * math.log10(person.speed_m_s)
                energy += _energy(heard_db(level_db, math.dist((*person.position_m, 0.0), here)))
        for root, dofs in self._robots:
            turning = float(np.abs(data.qvel[dofs]).sum())
            if turning > _SLOW_RAD_S:
                level_db = _MOTORS_DB + 10 * math.log10(turning)
                energy += _energy(heard_db(level_db, math.dist(data.xpos[root], here)))
        for name, (level_db, until_s) in list(self._world.sounds.items()):
            if time_s <= until_s:
                energy += _energy(heard_db(level_db, self._away(model, data, name, here)))
        self._world.tell({"sound_db": 10 * math.log10(energy)})

    def _away(self, model: Any, data: Any, name: str, here: Any) -> float:
        """How far away the robot is that makes a sound; a metre for anything else."""
        for root, _ in self._robots:
            if str(model.body(root).name).startswith(f"{name}{_ROBOT}"):
                return math.dist(data.xpos[root], here)
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


def heard_db(level_db: float, away_m: float) -> float:
    """What is heard of a source that has this level a metre away in the open."""
    direct = 1 / (4 * math.pi * max(away_m, _NEAR_M) ** 2)
    return level_db + 10 * math.log10(4 * math.pi) + 10 * math.log10(direct + 4 / _ABSORPTION_M2)


def _energy(level_db: float) -> float:
    return float(10 ** (level_db / 10))
