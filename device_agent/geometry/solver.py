"""Inverse kinematics: joint positions for the pose of a frame (``mink`` steps, ``daqp`` solves)."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

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
        lower: Of the joints [rad].
        upper: Of the joints [rad].

    Attributes:
        missed: How far the best try of the last search was from the pose [m], [rad].
    """

    def __init__(
        self, model: Any, qpos: Ints, frames: Mapping[str, tuple[bool, int]], *, lower: Floats, upper: Floats
    ) -> None:
        self._model = model
        self._qpos = qpos
        self._frames = frames
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

        with self._lock:
            qpos = self._model.qpos0.copy()
            qpos[self._qpos] = np.clip(start, self._lower + _INSIDE_RAD, self._upper - _INSIDE_RAD)
            configuration = mink.Configuration(self._model, q=qpos)
            is_site, _ = self._frames[frame]
            task = mink.FrameTask(frame, "site" if is_site else "body", position_cost=1.0, orientation_cost=0.3)
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3(pose[1]), pose[0]))
            limits = [mink.ConfigurationLimit(self._model)]
            miss = (np.inf, np.inf)
            for _ in range(_STEPS):
                error = task.compute_error(configuration)
                miss = (float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])))
                if miss[0] <= _NEAR_M / 10 and miss[1] <= _NEAR_RAD / 10:
                    break
                try:
                    velocity = mink.solve_ik(
                        configuration, [task], _STEP_S, solver="daqp", damping=_DAMPING, limits=limits
                    )
                except mink.NoSolutionFound:
                    break
                configuration.integrate_inplace(velocity, _STEP_S)
            found: Floats = np.clip(configuration.q[self._qpos], self._lower, self._upper)
            return found, miss
