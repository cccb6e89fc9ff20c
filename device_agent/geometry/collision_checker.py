"""Clearance of a robot's positions and paths in its scene."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.geometry.collision_pairs import CollisionPairs
from device_agent.geometry.dependent_joints import DependentJoints
from device_agent.ports.geometry import Clearance, Sweep
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

STEP_M = 0.01
"""An approach by less than this, followed by a retreat, may be missed: half of the usual margin."""
_GLANCE_SAMPLES = 6
_BISECTIONS = 3
"""Number of bisections for the end of the clear part."""
_SAME_M = 1e-7
"""Smaller changes of a distance are ignored: far above rounding errors."""

_SINGULAR = 0.08
"""Jogs are damped below this least singular value. A UR5 has 0.2 at home, and 0 with wrist or elbow stretched."""
_DAMPING = 0.08
_NOTHING = 1e-9


class CollisionChecker:
    """Checks positions with its own ``MjData``. Not thread-safe: use one per thread, or a lock.

    Args:
        model: ``MjModel``.
        qpos: Indices of the joints in ``qpos``.
        pairs: Shape pairs to check.
        equality_joints: Dependent joints of the model.
        at_rad: Initial joint position, shape (n,) [rad].
    """

    def __init__(
        self,
        model: Any,
        qpos: Ints,
        pairs: CollisionPairs,
        equality_joints: EqualityJoints,
        at_rad: Sequence[float] | Floats,
    ) -> None:
        self._model = model
        self._qpos = qpos
        self._pairs = pairs
        self._equality_joints = equality_joints
        self.data: Any = mujoco.MjData(model)
        self.place(at_rad)
        self._measured = np.asarray(at_rad, dtype=np.float64), pairs.excess_bounds(self.data)

    def place(self, position_rad: Sequence[float] | Floats) -> None:
        """Set the joint position, shape (n,) [rad]."""
        self.data.qpos[self._qpos] = position_rad
        self._equality_joints.apply(self.data.qpos)
        mujoco.mj_kinematics(self._model, self.data)

    def clearance(self, position_rad: Sequence[float] | Floats) -> Clearance:
        """The smallest clearance in one position."""
        self.place(position_rad)
        return self._pairs.tightest(self.data)

    def clear(self, position_rad: Floats) -> bool:
        """Whether every pair keeps its margin."""
        if self._within(position_rad[np.newaxis]):
            return True
        self.place(position_rad)
        return not self._pairs.violations(self.data)

    def sweep(self, path_rad: Sequence[Sequence[float]] | Floats) -> Sweep:
        """Follow straight segments until a pair violates its margin or worsens a violation."""
        path = np.asarray(path_rad, dtype=np.float64)
        segments = np.diff(path, axis=0)
        if self._clear_by_bounds(path):
            return Sweep(1.0)
        self.place(path[0])
        approaching = self._pairs.approaching(self.data, np.abs(segments))
        for index, segment in enumerate(segments):
            share = 0.0
            while share < 1.0 and approaching.any:
                checked = share
                share = min(1.0, share + approaching.safe_share(index, STEP_M))
                self.place(path[index] + share * segment)
                approaching.update(self.data, index, share)
                if approaching.is_violated(_SAME_M):
                    return Sweep((index + checked) / len(segments), approaching.tightest())
        return Sweep(1.0)

    def glance(self, start_rad: Sequence[float], end_rad: Sequence[float]) -> float:
        """Clear share of a straight segment, estimated from six samples and three bisections."""
        start, motion = np.asarray(start_rad, dtype=np.float64), np.subtract(end_rad, start_rad)
        self.place(start)
        before = self._pairs.violations(self.data)

        def clear(share: float) -> bool:
            position = start + share * motion
            if self._within(position[np.newaxis]):
                return True
            self.place(position)
            return self._pairs.violations(self.data) <= before

        for index in range(_GLANCE_SAMPLES):
            if not clear((index + 1) / _GLANCE_SAMPLES):
                low, half = index / _GLANCE_SAMPLES, 0.5 / _GLANCE_SAMPLES
                for _ in range(_BISECTIONS):
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
        dependent: DependentJoints,
        tool: bool,
    ) -> tuple[float, ...]:
        """See ``RobotGeometry.rates``."""
        self.place(position_rad)
        data, model = self.data, self._model
        mujoco.mj_comPos(model, data)
        whole = np.empty((6, model.nv))
        jacobian_of = mujoco.mj_jacSite if is_site else mujoco.mj_jacBody
        jacobian_of(model, data, whole[:3], whole[3:], index)
        own = data.site_xmat[index] if is_site else data.xmat[index]
        axes = (own if tool else data.xmat[base]).reshape(3, 3)
        target_twist = np.concatenate((axes @ twist[:3], axes @ twist[3:]))
        jacobian = whole @ dependent.whole
        # Damping increases near a singularity, so that joints slow down instead of jumping.
        left, sizes, right = np.linalg.svd(jacobian, full_matrices=False)
        near = np.clip(1.0 - sizes[-1] / _SINGULAR, 0.0, 1.0)
        velocity = right.T @ (sizes / (sizes**2 + (near * _DAMPING) ** 2 + _NOTHING) * (left.T @ target_twist))
        return tuple((dependent.spread @ velocity).tolist())

    def _clear_by_bounds(self, path: Floats) -> bool:
        """Whether a path is clear by the clearances measured last; covers most paths at low cost.

        The bound on each clearance shrinks with each joint's distance from the measured position: corners suffice.
        Measures again if the bound does not suffice.
        """
        if self._within(path):
            return True
        self.place(path[0])
        self._measured = path[0], self._pairs.excess_bounds(self.data)
        return self._within(path)

    def _within(self, path: Floats) -> bool:
        origin, excess_m = self._measured
        return bool(np.all(self._pairs.closing(np.abs(path - origin)) <= excess_m))
