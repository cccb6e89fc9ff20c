"""Joints without a motor that follow others: rods, threads, the second finger of a gripper.

A model describes them as equality constraints of two joints or of one fixed tendon. The physics enforces them; code
that places a robot without stepping must compute them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
SCALAR_JOINTS = frozenset({int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)})
"""Joint types with one position. As ``int``: MuJoCo's enumerations do not equal the numbers in its arrays."""


@dataclass(frozen=True, slots=True)
class EqualityJoint:
    """One dependent joint: position = ``offset`` + sum of factor times position.

    Attributes:
        joint: Index in the model.
        offset: Position when the other joints are at 0 [rad or m].
        factors: Index of the other joint → factor.
    """

    joint: int
    offset: float
    factors: Mapping[int, float]


class EqualityJoints:
    """All dependent joints of a model, each after the joints that it depends on.

    Polynomials of higher degree are linearised at the model's reference position.

    Args:
        model: ``MjModel``.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        driven = {int(joint) for joint in _driven(model)}
        self.all = _in_order(
            [joint for index in range(model.neq) if (joint := _equality_joint(model, index, driven)) is not None]
        )
        count = len(self.all)
        self._to = np.array([model.jnt_qposadr[dependent.joint] for dependent in self.all], dtype=np.intp)
        self._offset, self._factors = np.zeros(count), np.zeros((count, model.nq))
        row_of: dict[int, int] = {}
        for row, dependent in enumerate(self.all):
            self._offset[row] = dependent.offset
            for other, factor in dependent.factors.items():
                if other in row_of:
                    self._offset[row] += factor * self._offset[row_of[other]]
                    self._factors[row] += factor * self._factors[row_of[other]]
                else:
                    self._factors[row, model.jnt_qposadr[other]] += factor
            row_of[dependent.joint] = row
        self._row_of = row_of

    def apply(self, qpos: Floats) -> None:
        """Set the dependent joints in place."""
        if self.all:
            qpos[self._to] = self._offset + self._factors @ qpos

    def factors_of(self, joint: int) -> dict[int, float]:
        """Independent joint index → factor, for a dependent joint; empty for any other joint."""
        if joint not in self._row_of:
            return {}
        row = self._factors[self._row_of[joint]]
        return {
            other: float(row[address])
            for other, address in enumerate(self._model.jnt_qposadr)
            if self._model.jnt_type[other] in SCALAR_JOINTS and row[address]
        }

    def offset(self, joint: int) -> float:
        """Position of a dependent joint when all independent ones are at 0 [rad or m]; 0 for others."""
        row = self._row_of.get(joint)
        return 0.0 if row is None else float(self._offset[row])


def _driven(model: Any) -> list[int]:
    """Joints with their own actuator."""
    joints = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    return [int(joint) for joint in model.actuator_trnid[joints, 0]]


def _equality_joint(model: Any, index: int, driven: set[int]) -> EqualityJoint | None:
    if not model.eq_active0[index]:
        return None
    kind, first, second = int(model.eq_type[index]), int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    constant, slope = (float(value) for value in model.eq_data[index, :2])
    if kind == int(mujoco.mjtEq.mjEQ_JOINT) and second >= 0:
        if first in driven and second not in driven and slope:  # written in the opposite direction
            first, second, constant, slope = second, first, -constant / slope, 1 / slope
        reference = model.qpos0[model.jnt_qposadr[[first, second]]]
        return EqualityJoint(first, float(reference[0] + constant - slope * reference[1]), {second: slope})
    if kind == int(mujoco.mjtEq.mjEQ_TENDON) and second < 0:
        return _from_tendon(model, first, constant, driven)
    return None


def _from_tendon(model: Any, tendon: int, constant: float, driven: set[int]) -> EqualityJoint | None:
    """From a fixed tendon of constant length with exactly one joint without a motor."""
    start = model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    if any(int(model.wrap_type[wrap]) != int(mujoco.mjtWrap.mjWRAP_JOINT) for wrap in wraps):
        return None
    parts = {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}
    passive = [joint for joint in parts if joint not in driven]
    if len(passive) != 1 or not parts[passive[0]]:
        return None
    own = parts.pop(passive[0])
    at = {joint: float(model.qpos0[model.jnt_qposadr[joint]]) for joint in (*parts, passive[0])}
    weighted = sum(part * at[joint] for joint, part in parts.items())
    return EqualityJoint(
        passive[0], at[passive[0]] + (constant + weighted) / own, {joint: -part / own for joint, part in parts.items()}
    )


def _in_order(joints: list[EqualityJoint]) -> tuple[EqualityJoint, ...]:
    """Each joint after those that it depends on; circular dependencies are dropped."""
    dependents = {dependent.joint for dependent in joints}
    ordered: list[EqualityJoint] = []
    while True:
        known = {dependent.joint for dependent in ordered}
        ready = [
            dependent
            for dependent in joints
            if dependent.joint not in known
            and all(other in known or other not in dependents for other in dependent.factors)
        ]
        if not ready:
            return tuple(ordered)
        ordered.append(ready[0])
