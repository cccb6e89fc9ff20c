"""How firmly the servos of a simulated robot hold: gains between none and all of them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class Stiffness:
    """A ``Process``: nobody writes to the model beside the world's thread.

    A servo with less stiffness has that share of its gains. What holds a robot against gravity besides belongs to its
    motors, so it goes as well, for all that a slack joint carries: a limp arm hangs.

    Args:
        model: ``MjModel``, with every servo as it was made.
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
        self._wanted: dict[str, float] = {}
        self._done: dict[str, float] = self._wanted

    def want(self, value: float, joints: Sequence[str]) -> None:
        """From the next group of steps on these joints hold with this share, 0…1. Any thread."""
        self._wanted = {**self._wanted, **dict.fromkeys(joints, value)}

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """See ``Process``."""
        del data, time_s
        wanted = self._wanted
        if wanted is self._done:
            return
        compensation = self._compensation.copy()
        for name, value in wanted.items():
            servo, bodies = self._actuators[name], self._carried[name]
            model.actuator_gainprm[servo, 0] = self._gains[servo] * value
            model.actuator_biasprm[servo, 1:3] = self._biases[servo] * value
            compensation[bodies] = np.minimum(compensation[bodies], self._compensation[bodies] * value)
        own = sorted({body for bodies in self._carried.values() for body in bodies})
        model.body_gravcomp[own] = compensation[own]
        self._done = wanted


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
