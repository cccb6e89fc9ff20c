"""Several steps of MuJoCo with controls of their own, in one call.

Each call of MuJoCo lets other threads have the interpreter, and may wait for it longer than the steps take: with a call
for each step the laboratory's world, on a slow machine, stepped for a fifth of its time and waited for two.
"""

from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from device_agent.simulation.snapshot import Floats

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_USER = mujoco.mjtState.mjSTATE_USER.value


class Stepper:
    """Of one model; what it does is equal, bit by bit, to ``mj_step`` after each row of controls."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._rollout = rollout.Rollout(nthread=0)
        self._state = np.empty((1, mujoco.mj_stateSize(model, _PHYSICS)))
        self._user = np.empty(mujoco.mj_stateSize(model, _USER))

    def go(self, data: Any, controls: Floats) -> None:
        """Advance.

        Args:
            data: Of the model.
            controls: One row for each step, shape (steps, nu); the last stays.
        """
        count = len(controls)
        mujoco.mj_getState(self._model, data, self._state[0], _PHYSICS)
        mujoco.mj_getState(self._model, data, self._user, _USER)
        inputs = np.tile(self._user, (1, count, 1))
        inputs[0, :, : self._model.nu] = controls  # the first of the user's part of a state
        self._rollout.rollout(
            [self._model],
            [data],
            self._state,
            inputs,
            control_spec=_USER,
            skip_checks=True,
            nstep=count,
            initial_warmstart=data.qacc_warmstart[None].copy(),
            state=np.empty((1, count, self._state.shape[1])),
            sensordata=np.empty((1, count, self._model.nsensordata)),
        )
