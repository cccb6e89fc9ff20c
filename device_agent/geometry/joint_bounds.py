"""Admissible joint positions on a path: ranges, mirrored joints and position-dependent ranges."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from device_agent.protocol.manifests.robot_type import RobotType

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_INSIDE_RAD = 0.03
"""Distance to keep from a position-dependent bound if the path's ends allow it; for blending corners."""
_SAME_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Narrowed:
    """The range of ``joint`` depends on ``by`` (indices). Table rows: ``by``, lower, upper [rad]."""

    joint: int
    by: int
    table: Floats

    def distance_rad(self, position_rad: Floats) -> Floats:
        """Distance to the nearer bound, shape (positions,) [rad]; negative outside."""
        by, lower, upper = self.table
        other, own = position_rad[:, self.by], position_rad[:, self.joint]
        distance: Floats = np.minimum(own - np.interp(other, by, lower), np.interp(other, by, upper) - own)
        return distance

    def critical_positions(self, start: Floats, end: Floats) -> Floats:
        """Ends of a straight segment and its crossings of table rows; the bounds are nearest at one of them.

        Shape (positions, n) [rad].
        """
        distance = end[self.by] - start[self.by]
        shares = np.empty(0) if distance == 0 else (self.table[0] - start[self.by]) / distance
        inside = shares[(shares > 0) & (shares < 1)]
        positions: Floats = start + np.concatenate(([0.0, 1.0], inside))[:, np.newaxis] * (end - start)
        return positions


class JointBounds:
    """The bounds of one robot type's joints; positions are in the type's order, shape (n,) [rad].

    Args:
        robot_type: Its ranges, ``mimic_joints`` and ``position_dependent_limits``.

    Attributes:
        lower: Lower limit of each joint.
        upper: Upper limit of each joint.
        mirrored: Indices of the mirrored joints.
    """

    def __init__(self, robot_type: RobotType) -> None:
        index = {joint.name: number for number, joint in enumerate(robot_type.joints)}
        self.lower = np.array([joint.lower_rad for joint in robot_type.joints])
        self.upper = np.array([joint.upper_rad for joint in robot_type.joints])
        self._mirrors = [
            (index[mimic.joint], index[mimic.mimics], mimic.multiplier) for mimic in robot_type.mimic_joints
        ]
        self.mirrored: Ints = np.array([joint for joint, _, _ in self._mirrors], dtype=np.intp)
        self._narrowed = [
            _Narrowed(index[rule.joint], index[rule.depends_on], np.array(rule.table).T)
            for rule in robot_type.position_dependent_limits
        ]

    def apply_mirrors(self, position_rad: Floats) -> None:
        """Set the mirrored joints in place."""
        for joint, of, factor in self._mirrors:
            position_rad[joint] = position_rad[of] * factor

    def clearance(self, start: Floats, goal: Floats) -> Floats:
        """Distance to keep from each dependent bound, shape (ranges,) [rad]; not more than at the ends."""
        ends = np.stack((start, goal))
        return np.array(
            [min(_INSIDE_RAD, max(0.0, float(narrowed.distance_rad(ends).min()))) for narrowed in self._narrowed]
        )

    def admits(self, start: Floats, end: Floats, clearance: Floats) -> bool:
        """Whether a straight segment keeps these distances from all dependent bounds."""
        return all(
            bool(np.all(narrowed.distance_rad(narrowed.critical_positions(start, end)) >= least - _SAME_RAD))
            for narrowed, least in zip(self._narrowed, clearance.tolist(), strict=True)
        )
