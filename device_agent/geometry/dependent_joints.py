"""Maps independent joints to all joints that move with them: mirrored and equality joints."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_NOTHING = 1e-9


class DependentJoints:
    """How a whole model moves with the joints of one robot.

    Args:
        model: ``MjModel``.
        robot_type: Its joints and mirrors.
        joints: Their indices in the model, in the type's order.
        equality_joints: Dependent joints of the model.

    Attributes:
        leading: Indices, among the robot's joints, of those that mirror none, shape (m,).
        spread: Motion of each robot joint per unit of each leading one, shape (n, m).
        whole: The same for each degree of freedom of the model, shape (nv, m); 0 if the robot does not move it.
    """

    def __init__(
        self, model: Any, robot_type: RobotType, joints: Sequence[int], equality_joints: EqualityJoints
    ) -> None:
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
        for dependent in equality_joints.all:
            for other, factor in equality_joints.factors_of(dependent.joint).items():
                if other in joints and dependent.joint not in joints:
                    own[model.jnt_dofadr[dependent.joint], list(joints).index(other)] = factor
        self.whole: Floats = own @ self.spread

    def with_mirrors(self, position_rad: Floats) -> Floats:
        """The joint position with mirrored joints set from the leading ones, shape (n,) [rad]."""
        position: Floats = self.spread @ position_rad[self.leading]
        return position

    def constraint_rows(self) -> Floats:
        """Rows whose product with every permitted model motion is 0, shape (k, nv).

        Empty if the model has only the robot's joints and all are independent.
        """
        basis, sizes, _ = np.linalg.svd(self.whole, full_matrices=True)
        rank = int((sizes > _NOTHING).sum())
        rows: Floats = basis[:, rank:].T
        return rows
