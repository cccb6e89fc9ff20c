"""Stiffness of simulated servos: scales their gains."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class ServoGains:
    """``Process`` that applies joint stiffness to the model in the world's thread.

    A servo's gains scale with its stiffness. So does the gravity compensation of its bodies, because the motors provide
    it: a compliant arm hangs.

    Args:
        model: The unmodified ``MjModel``.
        actuators: Joint → its servo.
    """

    def __init__(self, model: Any, actuators: Mapping[str, int]) -> None:
        self._actuators = dict(actuators)
        servos = list(self._actuators.values())
        self._gains = {servo: float(model.actuator_gainprm[servo, 0]) for servo in servos}
        self._biases = {servo: np.array(model.actuator_biasprm[servo, 1:3]) for servo in servos}
        self._compensation = np.array(model.body_gravcomp)
        self._carried = {
            name: _carried(model, int(model.actuator_trnid[servo, 0])) for name, servo in actuators.items()
        }
        self._requested: dict[str, float] = {}
        self._applied: dict[str, float] = self._requested

    def set(self, value: float, joints: Sequence[str]) -> None:
        """Set the stiffness of these joints, 0…1, from the next group of steps on. Thread-safe."""
        self._requested = {**self._requested, **dict.fromkeys(joints, value)}

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del data, time_s
        requested = self._requested
        if requested is self._applied:
            return
        compensation = self._compensation.copy()
        for name, value in requested.items():
            servo, bodies = self._actuators[name], self._carried[name]
            model.actuator_gainprm[servo, 0] = self._gains[servo] * value
            model.actuator_biasprm[servo, 1:3] = self._biases[servo] * value
            compensation[bodies] = np.minimum(compensation[bodies], self._compensation[bodies] * value)
        own = sorted({body for bodies in self._carried.values() for body in bodies})
        model.body_gravcomp[own] = compensation[own]
        self._applied = requested


def _carried(model: Any, joint: int) -> list[int]:
    """The bodies that a joint moves."""
    root = int(model.jnt_bodyid[joint])
    bodies = []
    for body in range(root, model.nbody):
        above = body
        while above > root:
            above = int(model.body_parentid[above])
        if above == root:
            bodies.append(body)
    return bodies
