"""What moves with the joints that may be chosen: rods and threads (``mjcf.ties``), and joints of one motor."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_NOTHING = 1e-9


class Carried:
    """How a whole model moves when the joints of one robot do.

    Args:
        model: ``MjModel``.
        robot_type: Its joints, and which of them mirror others.
        joints: Their indices in the model, in the type's order.
        ties: Which joints of the model go with these.

    Attributes:
        leading: Indices, among the robot's joints, of those that mirror none, shape (m,).
        spread: What each of the robot's joints does per unit of each leading one, shape (n, m).
        whole: The same of each of the model's degrees of freedom, shape (nv, m): 0 of what the robot does not move.
    """

    def __init__(self, model: Any, robot_type: RobotType, joints: Sequence[int], ties: EqualityJoints) -> None:
        names = [joint.name for joint in robot_type.joints]
        mirrors = {mirror.joint: mirror for mirror in robot_type.mimic_joints}
        self.leading: Ints = np.array([index for index, name in enumerate(names) if name not in mirrors], dtype=np.intp)
        self.spread: Floats = np.eye(len(names))
        for mirror in robot_type.mimic_joints:
            self.spread[names.index(mirror.joint)] = mirror.multiplier * self.spread[names.index(mirror.mimics)]
        self.spread = self.spread[:, self.leading]
        own = np.zeros((model.nv, len(names)))
        for index, joint in enumerate(joints):
            own[model.jnt_dofadr[joint], index] = 1.0
        for tie in ties.all:
            for other, factor in ties.of(tie.joint).items():
                if other in joints and tie.joint not in joints:
                    own[model.jnt_dofadr[tie.joint], list(joints).index(other)] = factor
        self.whole: Floats = own @ self.spread

    def together(self, position_rad: Floats) -> Floats:
        """The robot's joints where the leading ones are there, shape (n,) [rad]."""
        placed: Floats = self.spread @ position_rad[self.leading]
        return placed

    def held(self) -> Floats:
        """Rows that a motion of the whole model times is 0 for: what is carried goes along, the rest stays, (k, nv).

        Empty where the robot's joints are all there is and each is free.
        """
        basis, sizes, _ = np.linalg.svd(self.whole, full_matrices=True)
        rank = int((sizes > _NOTHING).sum())
        rows: Floats = basis[:, rank:].T
        return rows
