"""Looks at a robot in its scene: how near things are in a position, and how far a way is clear."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.collision_pairs import Pairs
from device_agent.geometry.dependent_joints import Carried
from device_agent.ports.geometry import Clearance, Sweep
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

STEP_M = 0.01
"""What comes nearer by less than this, and goes away again, may be missed: half of the usual margin."""
_GLANCES = 6
_CLOSER = 3
"""How often the place is halved in which a glance finds a way to end."""
_SAME_M = 1e-7
"""Less than this is no change of a distance: far above rounding, far below what creeping could add up to."""

_SINGULAR = 0.08
"""Below this least singular value a jog is damped: a UR5 at home has 0.2, with its wrist or elbow stretched 0."""
_DAMPING = 0.08
_NOTHING = 1e-9


class Probe:
    """One ``MjData`` to look with. Not thread-safe: whoever looks has one of its own, or locks.

    Args:
        model: ``MjModel``.
        qpos: Where the joints are in ``qpos``.
        pairs: What may come near what.
        ties: Which joints go with these.
        at_rad: Where it begins to look, shape (n,) [rad].
    """

    def __init__(
        self, model: Any, qpos: Ints, pairs: Pairs, ties: EqualityJoints, at_rad: Sequence[float] | Floats
    ) -> None:
        self._model = model
        self._qpos = qpos
        self._pairs = pairs
        self._ties = ties
        self.data: Any = mujoco.MjData(model)
        self.place(at_rad)
        self._measured = np.asarray(at_rad, dtype=np.float64), pairs.rooms_at_least(self.data)

    def place(self, position_rad: Sequence[float] | Floats) -> None:
        """Put the joints there, shape (n,) [rad]."""
        self.data.qpos[self._qpos] = position_rad
        self._ties.settle(self.data.qpos)
        mujoco.mj_kinematics(self._model, self.data)

    def clearance(self, position_rad: Sequence[float] | Floats) -> Clearance:
        """The tightest place of the robot in one position."""
        self.place(position_rad)
        return self._pairs.tightest(self.data)

    def clear(self, position_rad: Floats) -> bool:
        """Whether nothing is nearer than it may be."""
        if self._within(position_rad[np.newaxis]):
            return True
        self.place(position_rad)
        return not self._pairs.too_near(self.data)

    def sweep(self, path_rad: Sequence[Sequence[float]] | Floats) -> Sweep:
        """Go from one joint position straight to the next until something is too near, or nearer than it was."""
        path = np.asarray(path_rad, dtype=np.float64)
        legs = np.diff(path, axis=0)
        if self._surely_clear(path):
            return Sweep(1.0)
        self.place(path[0])
        near = self._pairs.near(self.data, np.abs(legs))
        for index, leg in enumerate(legs):
            share = 0.0
            while share < 1.0 and near.any:
                gone = share
                share = min(1.0, share + near.safe_share(index, STEP_M))
                self.place(path[index] + share * leg)
                near.look(self.data, index, share)
                if near.broken(_SAME_M):
                    return Sweep((index + gone) / len(legs), near.tightest())
        return Sweep(1.0)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """The share of a straight way that seems clear, by six places on it, and three where it ends."""
        start, way = np.asarray(start_rad, dtype=np.float64), np.subtract(end_rad, start_rad)
        self.place(start)
        before = self._pairs.too_near(self.data)

        def clear(share: float) -> bool:
            there = start + share * way
            if self._within(there[np.newaxis]):
                return True
            self.place(there)
            return self._pairs.too_near(self.data) <= before

        for index in range(_GLANCES):
            if not clear((index + 1) / _GLANCES):
                low, half = index / _GLANCES, 0.5 / _GLANCES
                for _ in range(_CLOSER):
                    low, half = (low + half if clear(low + half) else low), half / 2
                return low
        return 1.0

    def rates(
        self,
        base: int,
        is_site: bool,
        index: int,
        twist: Floats,
        position_rad: Sequence[float],
        *,
        carried: Carried,
        tool: bool,
    ) -> tuple[float, ...]:
        """See ``Geometry.rates``."""
        self.place(position_rad)
        data, model = self.data, self._model
        mujoco.mj_comPos(model, data)
        whole = np.empty((6, model.nv))
        jacobian_of = mujoco.mj_jacSite if is_site else mujoco.mj_jacBody
        jacobian_of(model, data, whole[:3], whole[3:], index)
        own = data.site_xmat[index] if is_site else data.xmat[index]
        axes = (own if tool else data.xmat[base]).reshape(3, 3)
        asked = np.concatenate((axes @ twist[:3], axes @ twist[3:]))
        jacobian = whole @ carried.whole
        # The nearer to a singularity, the more damping: joints then follow slowly instead of jumping.
        left, sizes, right = np.linalg.svd(jacobian, full_matrices=False)
        near = np.clip(1.0 - sizes[-1] / _SINGULAR, 0.0, 1.0)
        found = right.T @ (sizes / (sizes**2 + (near * _DAMPING) ** 2 + _NOTHING) * (left.T @ asked))
        return tuple((carried.spread @ found).tolist())

    def _surely_clear(self, path: Floats) -> bool:
        """Whether nothing can come too near, by the room there was where it was last measured: most ways, cheaply.

        How near a pair may have come grows with each joint's distance from there, so the corners of a path tell it all.
        Measured anew where that does not suffice.
        """
        if self._within(path):
            return True
        self.place(path[0])
        self._measured = path[0], self._pairs.rooms_at_least(self.data)
        return self._within(path)

    def _within(self, path: Floats) -> bool:
        origin, room_m = self._measured
        return bool(np.all(self._pairs.closing(np.abs(path - origin)) <= room_m))
