"""Lever arms of joints: upper bounds of speeds and distances in any position."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from device_agent.simulation.mjcf.equality_joints import EqualityJoints

Floats = npt.NDArray[np.float64]

_ROUND = frozenset(
    int(kind) for kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
)
_SAME = 1e-6


class LeverArms:
    """Upper bounds of metres per radian (or per metre, for a slide), joint by joint.

    A dependent joint counts for the joints that it follows, scaled by its factors.

    Args:
        model: ``MjModel``.
        joints: Joint indices in the model.
        equality_joints: Dependent joints of the model.
    """

    def __init__(self, model: Any, joints: Sequence[int], equality_joints: EqualityJoints) -> None:
        self._model = model
        dependents = [dependent.joint for dependent in equality_joints.all if dependent.joint not in joints]
        self._joints = [*joints, *dependents]
        self._share = np.zeros((len(self._joints), len(joints)))
        self._share[: len(joints)] = np.eye(len(joints))
        for row, joint in enumerate(dependents, len(joints)):
            for other, factor in equality_joints.factors_of(joint).items():
                if other in joints:
                    self._share[row, self._joints.index(other)] = abs(factor)

    def of_geoms(self, geoms: Sequence[int]) -> Floats:
        """For every point of each shape, shape (geoms, joints)."""
        levers = np.array([self._of_ball(int(geom)) for geom in dict.fromkeys(geoms)])
        return levers.reshape(-1, len(self._joints)) @ self._share

    def of_frame(self, is_site: bool, index: int) -> Floats:
        """For the origin of a site or body, shape (joints,)."""
        model = self._model
        body = int(model.site_bodyid[index]) if is_site else index
        return self._of_point(body, model.site_pos[index] if is_site else np.zeros(3), 0.0) @ self._share

    def reach_m(self, geom: int, base: int) -> float:
        """Largest distance of any point of a shape from the origin of the robot's base [m]."""
        model = self._model
        box = model.geom_aabb[geom]
        reach = float(np.linalg.norm(box[:3]) + np.linalg.norm(box[3:]) + np.linalg.norm(model.geom_pos[geom]))
        at = int(model.geom_bodyid[geom])
        while at not in (0, base):
            reach += sum(self._moves_m(joint) for joint in np.flatnonzero(model.jnt_bodyid == at).tolist())
            reach += float(np.linalg.norm(model.body_pos[at]))
            at = int(model.body_parentid[at])
        return reach

    def between(self, a: int, b: int) -> Floats:
        """How fast two shapes can approach, shape (joints,); joints that carry both do not count."""
        first, second = self._of_geom(a), self._of_geom(b)
        both = np.array([self._carries(joint, a) and self._carries(joint, b) for joint in self._joints], dtype=bool)
        lever: Floats = np.where(both, 0.0, first + second) @ self._share
        return lever

    def _of_geom(self, geom: int) -> Floats:
        """For a shape; a joint that only turns it about its own axis counts as 0."""
        lever = self._of_ball(geom)
        for index, joint in enumerate(self._joints):
            if self._model.jnt_bodyid[joint] == self._model.geom_bodyid[geom] and self._turns_in_place(geom, joint):
                lever[index] = 0.0
        return lever

    def _of_ball(self, geom: int) -> Floats:
        """For the bounding sphere of a shape."""
        model = self._model
        box = model.geom_aabb[geom]
        radius_m = float(np.linalg.norm(box[:3]) + np.linalg.norm(box[3:]))
        return self._of_point(int(model.geom_bodyid[geom]), model.geom_pos[geom], radius_m)

    def _of_point(self, body: int, position: Floats, radius_m: float) -> Floats:
        """For a sphere fixed in a body."""
        model = self._model
        lever = np.zeros(len(self._joints))
        reach, at = float(np.linalg.norm(position)) + radius_m, body
        while at > 0:
            for joint in np.flatnonzero(model.jnt_bodyid == at).tolist():
                if joint in self._joints:
                    offset = float(np.linalg.norm(model.jnt_pos[joint]))
                    lever[self._joints.index(joint)] = 1.0 if self._slides(joint) else reach + offset
                reach += self._moves_m(joint)
            reach += float(np.linalg.norm(model.body_pos[at]))
            at = int(model.body_parentid[at])
        return lever

    def _slides(self, joint: int) -> bool:
        return bool(self._model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE))

    def _moves_m(self, joint: int) -> float:
        """Largest displacement of the body's origin by the joint [m]."""
        if self._slides(joint):
            return float(np.max(np.abs(self._model.jnt_range[joint])))
        return 2 * float(np.linalg.norm(self._model.jnt_pos[joint]))

    def _carries(self, joint: int, geom: int) -> bool:
        at = int(self._model.geom_bodyid[geom])
        while at > 0 and at != self._model.jnt_bodyid[joint]:
            at = int(self._model.body_parentid[at])
        return at > 0

    def _turns_in_place(self, geom: int, joint: int) -> bool:
        """Whether a shape is symmetric about the joint's axis, so that the joint does not move it."""
        model = self._model
        if model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_HINGE) or int(model.geom_type[geom]) not in _ROUND:
            return False
        axis = model.jnt_axis[joint] / np.linalg.norm(model.jnt_axis[joint])
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
        offset = model.geom_pos[geom] - model.jnt_pos[joint]
        on_axis = np.linalg.norm(np.cross(axis, offset)) < _SAME
        sphere = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_SPHERE)
        along = sphere or np.linalg.norm(np.cross(axis, matrix.reshape(3, 3)[:, 2])) < _SAME
        return bool(on_axis and along)
