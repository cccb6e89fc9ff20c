"""Inverse kinematics: joint positions for a frame pose (``mink`` with the ``daqp`` solver)."""

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.geometry.dependent_joints import DependentJoints
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
"""Starts are moved this far inside their range; the solver cannot leave a bound exactly."""


class InverseKinematics:
    """Finds joint positions. Thread-safe.

    Args:
        model: ``MjModel``.
        qpos: Indices of the joints in ``qpos``.
        frames: Name → whether it is a site, and its index.
        dependent: Joints that move with the robot's; everything else in the model is fixed.
        equality_joints: Dependent joints of the model.
        lower: Lower joint limits [rad].
        upper: Upper joint limits [rad].

    Attributes:
        error: Smallest error of the last search [m], [rad].
    """

    def __init__(
        self,
        model: Any,
        qpos: Ints,
        frames: Mapping[str, tuple[bool, int]],
        *,
        dependent: DependentJoints,
        equality_joints: EqualityJoints,
        lower: Floats,
        upper: Floats,
    ) -> None:
        self._model = model
        self._qpos = qpos
        self._frames = frames
        self._dependent, self._equality_joints, self._fixed_rows = (
            dependent,
            equality_joints,
            dependent.constraint_rows(),
        )
        self._lower, self._upper = lower, upper
        self._lock = threading.Lock()
        self.error = (0.0, 0.0)

    def solutions(self, frame: str, pose: tuple[Floats, Floats], *, starts: Sequence[Floats]) -> Iterator[Floats]:
        """Joint positions for the pose: from ``starts`` first, then from seeded random starts."""
        random = np.random.default_rng(_SEED)
        tries = [*starts, *(random.uniform(self._lower, self._upper) for _ in range(_RESTARTS))]
        least = (np.inf, np.inf)
        for start in tries:
            position, error = self._descend(frame, pose, start)
            if error[0] <= _NEAR_M and error[1] <= _NEAR_RAD:
                yield position
            least = min(least, error)
        self.error = least

    def _descend(self, frame: str, pose: tuple[Floats, Floats], start: Floats) -> tuple[Floats, tuple[float, float]]:
        import mink  # noqa: PLC0415 (takes 0.5 s; not needed without IK)

        from device_agent.geometry.ik_constraints import FixedDirections  # noqa: PLC0415 (imports ``mink``)

        with self._lock:
            inside = np.clip(start, self._lower + _INSIDE_RAD, self._upper - _INSIDE_RAD)
            configuration = mink.Configuration(self._model, q=self._full_qpos(inside))
            is_site, _ = self._frames[frame]
            task = mink.FrameTask(frame, "site" if is_site else "body", position_cost=1.0, orientation_cost=0.3)
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3(pose[1]), pose[0]))
            limits = [mink.ConfigurationLimit(self._model)]
            constraints = [FixedDirections(self._fixed_rows)] if len(self._fixed_rows) else None
            error = (np.inf, np.inf)
            for _ in range(_STEPS):
                error = _error_size(task.compute_error(configuration))
                if error[0] <= _NEAR_M / 10 and error[1] <= _NEAR_RAD / 10:
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
            position: Floats = np.clip(configuration.q[self._qpos], self._lower, self._upper)
            if constraints is not None:  # measure the error that the motors can achieve
                position = self._dependent.with_mirrors(position)
                configuration.update(self._full_qpos(position))
                error = _error_size(task.compute_error(configuration))
            return position, error

    def _full_qpos(self, position_rad: Floats) -> Floats:
        """``qpos`` of the whole model for this joint position."""
        qpos: Floats = self._model.qpos0.copy()
        qpos[self._qpos] = self._dependent.with_mirrors(position_rad)
        self._equality_joints.apply(qpos)
        return qpos


def _error_size(error: Floats) -> tuple[float, float]:
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
