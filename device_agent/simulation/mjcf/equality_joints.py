"""Joints without a motor of their own that go with others: rods, threads, the second finger of a gripper.

In a model they are equality constraints: of two joints, or of one fixed tendon over several. The physics holds them;
whoever places a robot without stepping it, or draws it, has to work them out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
_SCALAR = frozenset({int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)})


@dataclass(frozen=True, slots=True)
class EqualityJoint:
    """One joint that goes with others: position = ``offset`` + sum of factor times position.

    Attributes:
        joint: Its index in the model.
        offset: Where it is when the others are at 0 [rad or m].
        factors: Index of the other joint → how much it moves per unit of it.
    """

    joint: int
    offset: float
    factors: Mapping[int, float]


class EqualityJoints:
    """All ties of a model, in an order in which each needs only what was worked out before.

    Curved ones (a polynomial of higher degree) are taken as their tangent at the model's reference position.

    Args:
        model: ``MjModel``.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        driven = {int(joint) for joint in _driven(model)}
        found = [tie for index in range(model.neq) if (tie := _tie(model, index, driven)) is not None]
        self.all = _in_order(found)
        count = len(self.all)
        self._to = np.array([model.jnt_qposadr[tie.joint] for tie in self.all], dtype=np.intp)
        self._offset, self._factors = np.zeros(count), np.zeros((count, model.nq))
        row_of: dict[int, int] = {}
        for row, tie in enumerate(self.all):
            self._offset[row] = tie.offset
            for other, factor in tie.factors.items():
                if other in row_of:
                    self._offset[row] += factor * self._offset[row_of[other]]
                    self._factors[row] += factor * self._factors[row_of[other]]
                else:
                    self._factors[row, model.jnt_qposadr[other]] += factor
            row_of[tie.joint] = row
        self._row_of = row_of

    def settle(self, qpos: Floats) -> None:
        """Put the tied joints where the others have them, in place."""
        if self.all:
            qpos[self._to] = self._offset + self._factors @ qpos

    def of(self, joint: int) -> dict[int, float]:
        """How much a tied joint moves per unit of each that is not tied: joint index → factor; empty for any other."""
        if joint not in self._row_of:
            return {}
        row = self._factors[self._row_of[joint]]
        return {
            other: float(row[address])
            for other, address in enumerate(self._model.jnt_qposadr)
            if self._model.jnt_type[other] in _SCALAR and row[address]
        }

    def offset(self, joint: int) -> float:
        """Where a tied joint is when all that it goes with are at 0 [rad or m]; 0 of one that is not tied."""
        row = self._row_of.get(joint)
        return 0.0 if row is None else float(self._offset[row])


def _driven(model: Any) -> list[int]:
    """Joints that an actuator moves by itself."""
    joints = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    return [int(joint) for joint in model.actuator_trnid[joints, 0]]


def _tie(model: Any, index: int, driven: set[int]) -> EqualityJoint | None:
    if not model.eq_active0[index]:
        return None
    kind, first, second = int(model.eq_type[index]), int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    constant, slope = (float(value) for value in model.eq_data[index, :2])
    if kind == int(mujoco.mjtEq.mjEQ_JOINT) and second >= 0:
        if first in driven and second not in driven and slope:  # written the other way round
            first, second, constant, slope = second, first, -constant / slope, 1 / slope
        reference = model.qpos0[model.jnt_qposadr[[first, second]]]
        return EqualityJoint(first, float(reference[0] + constant - slope * reference[1]), {second: slope})
    if kind == int(mujoco.mjtEq.mjEQ_TENDON) and second < 0:
        return _of_tendon(model, first, constant, driven)
    return None


def _of_tendon(model: Any, tendon: int, constant: float, driven: set[int]) -> EqualityJoint | None:
    """Of a fixed tendon that keeps its length, with one joint in it that has no motor."""
    start = model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    if any(int(model.wrap_type[wrap]) != int(mujoco.mjtWrap.mjWRAP_JOINT) for wrap in wraps):
        return None
    parts = {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}
    loose = [joint for joint in parts if joint not in driven]
    if len(loose) != 1 or not parts[loose[0]]:
        return None
    own = parts.pop(loose[0])
    at = {joint: float(model.qpos0[model.jnt_qposadr[joint]]) for joint in (*parts, loose[0])}
    pulled = sum(part * at[joint] for joint, part in parts.items())
    return EqualityJoint(
        loose[0], at[loose[0]] + (constant + pulled) / own, {joint: -part / own for joint, part in parts.items()}
    )


def _in_order(found: list[EqualityJoint]) -> tuple[EqualityJoint, ...]:
    """Each after those that it needs; one that would need itself is left out."""
    tied = {tie.joint for tie in found}
    done: list[EqualityJoint] = []
    while True:
        known = {tie.joint for tie in done}
        free = [
            tie
            for tie in found
            if tie.joint not in known and all(other in known or other not in tied for other in tie.factors)
        ]
        if not free:
            return tuple(done)
        done.append(free[0])
