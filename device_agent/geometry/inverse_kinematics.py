"""Inverse kinematics: joint positions for the pose of a frame (``mink`` steps, ``daqp`` solves)."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.geometry.dependent_joints import Carried
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_STEPS = 60
_STEP_S = 0.1
_RESTARTS = 40
_SEED = 4
_NEAR_M = 1e-4
_NEAR_RAD = 1e-3
_DAMPING = 1e-4
_INSIDE_RAD = 1e-6
"""A start this far inside its range: a step from its very end finds no way out of it."""


class Solver:
    """Looks for joint positions. Thread-safe.

    Args:
        model: ``MjModel``.
        qpos: Where the joints are in ``qpos``.
        frames: Name → whether it is a site, and its index.
        carried: What goes with the joints; all else in the model stays where it is.
        ties: How that settles.
        lower: Of the joints [rad].
        upper: Of the joints [rad].

    Attributes:
        missed: How far the best try of the last search was from the pose [m], [rad].
    """

    def __init__(
        self,
        model: Any,
        qpos: Ints,
        frames: Mapping[str, tuple[bool, int]],
        *,
        carried: Carried,
        ties: EqualityJoints,
        lower: Floats,
        upper: Floats,
    ) -> None:
        self._model = model
        self._qpos = qpos
        self._frames = frames
        self._carried, self._ties, self._held = carried, ties, carried.held()
        self._lower, self._upper = lower, upper
        self._lock = threading.Lock()
        self.missed = (0.0, 0.0)

    def solutions(self, frame: str, pose: tuple[Floats, Floats], *, starts: Sequence[Floats]) -> Iterator[Floats]:
        """Joint positions in which the frame has the pose, those near ``starts`` first, then seeded ones."""
        random = np.random.default_rng(_SEED)
        tries = [*starts, *(random.uniform(self._lower, self._upper) for _ in range(_RESTARTS))]
        best = (np.inf, np.inf)
        for start in tries:
            found, miss = self._descend(frame, pose, start)
            if miss[0] <= _NEAR_M and miss[1] <= _NEAR_RAD:
                yield found
            best = min(best, miss)
        self.missed = best

    def _descend(self, frame: str, pose: tuple[Floats, Floats], start: Floats) -> tuple[Floats, tuple[float, float]]:
        import mink  # noqa: PLC0415 (half a second, for who asks for a pose only)

        from device_agent.geometry.ik_constraints import Holding  # noqa: PLC0415 (it needs ``mink``)

        with self._lock:
            inside = np.clip(start, self._lower + _INSIDE_RAD, self._upper - _INSIDE_RAD)
            configuration = mink.Configuration(self._model, q=self._placed(inside))
            is_site, _ = self._frames[frame]
            task = mink.FrameTask(frame, "site" if is_site else "body", position_cost=1.0, orientation_cost=0.3)
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3(pose[1]), pose[0]))
            limits = [mink.ConfigurationLimit(self._model)]
            constraints = [Holding(self._held)] if len(self._held) else None
            miss = (np.inf, np.inf)
            for _ in range(_STEPS):
                miss = _miss(task.compute_error(configuration))
                if miss[0] <= _NEAR_M / 10 and miss[1] <= _NEAR_RAD / 10:
                    break
                try:
                    velocity = mink.solve_ik(
                        configuration,
                        [task],
                        _STEP_S,
                        solver="daqp",
                        damping=_DAMPING,
                        limits=limits,
                        constraints=constraints,
                    )
                except mink.NoSolutionFound:
                    break
                configuration.integrate_inplace(velocity, _STEP_S)
            found: Floats = np.clip(configuration.q[self._qpos], self._lower, self._upper)
            if constraints is not None:  # what counts is where the motors bring the frame, with all that they carry
                found = self._carried.together(found)
                configuration.update(self._placed(found))
                miss = _miss(task.compute_error(configuration))
            return found, miss

    def _placed(self, position_rad: Floats) -> Floats:
        """``qpos`` of the whole model with the joints there, or as near as mirrors allow."""
        qpos: Floats = self._model.qpos0.copy()
        qpos[self._qpos] = self._carried.together(position_rad)
        self._ties.settle(qpos)
        return qpos


def _miss(error: Floats) -> tuple[float, float]:
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
