"""Several MuJoCo steps with different controls in one call.

Each MuJoCo call releases the interpreter lock and may wait to regain it for longer than the steps take. On a slow
machine, one call per step made the laboratory world wait twice as long as it computed.
"""

from typing import Any

import mujoco
import numpy as np
from mujoco import rollout

from device_agent.simulation.snapshot import Floats

_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
_USER = mujoco.mjtState.mjSTATE_USER.value


class Stepper:
    """Steps one model; bit-identical to ``mj_step`` after each row of controls."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._rollout = rollout.Rollout(nthread=0)
        self._state = np.empty((1, mujoco.mj_stateSize(model, _PHYSICS)))
        self._user = np.empty(mujoco.mj_stateSize(model, _USER))

    def step(self, data: Any, controls: Floats) -> None:
        """Advance the simulation.

        Args:
            data: ``MjData`` of the model.
            controls: One row per step, shape (steps, nu); the last row stays in effect.
        """
        count = len(controls)
        mujoco.mj_getState(self._model, data, self._state[0], _PHYSICS)
        mujoco.mj_getState(self._model, data, self._user, _USER)
        inputs = np.tile(self._user, (1, count, 1))
        inputs[0, :, : self._model.nu] = controls  # controls come first in the user state
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
