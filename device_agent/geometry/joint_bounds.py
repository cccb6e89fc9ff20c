"""Where joints may be on a way: each in its range, together where one motor moves two or one narrows another."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from device_agent.protocol.manifests.robot_type import RobotType

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]

_INSIDE_RAD = 0.03
"""What is left to the edge of a range that narrows, where the ends of a way have as much: for rounding off corners."""
_SAME_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Narrowed:
    """The range of ``joint`` depends on ``by``; both are indices. The table is ``by``, lower, upper by row [rad]."""

    joint: int
    by: int
    table: Floats

    def room_rad(self, position_rad: Floats) -> Floats:
        """How far it is to the nearer edge, shape (places,) [rad]; negative outside."""
        by, lower, upper = self.table
        there, place = position_rad[:, self.by], position_rad[:, self.joint]
        room: Floats = np.minimum(place - np.interp(there, by, lower), np.interp(there, by, upper) - place)
        return room

    def places(self, start: Floats, end: Floats) -> Floats:
        """The ends of a straight way, and where it crosses rows of the table: between them the room is at least theirs.

        Shape (places, n) [rad].
        """
        way = end[self.by] - start[self.by]
        shares = np.empty(0) if way == 0 else (self.table[0] - start[self.by]) / way
        inside = shares[(shares > 0) & (shares < 1)]
        found: Floats = start + np.concatenate(([0.0, 1.0], inside))[:, np.newaxis] * (end - start)
        return found


class Bounds:
    """The bounds of one robot type's joints; positions are in the type's order, shape (n,) [rad].

    Args:
        robot_type: With its ranges, ``mirrors`` and ``narrowing``.

    Attributes:
        lower: Of each joint.
        upper: The same.
        led: The joints that follow others.
    """

    def __init__(self, robot_type: RobotType) -> None:
        index = {joint.name: number for number, joint in enumerate(robot_type.joints)}
        self.lower = np.array([joint.lower_rad for joint in robot_type.joints])
        self.upper = np.array([joint.upper_rad for joint in robot_type.joints])
        self._mirrors = [(index[one.joint], index[one.mimics], one.multiplier) for one in robot_type.mimic_joints]
        self.led: Ints = np.array([joint for joint, _, _ in self._mirrors], dtype=np.intp)
        self._narrowed = [
            _Narrowed(index[one.joint], index[one.depends_on], np.array(one.table).T)
            for one in robot_type.position_dependent_limits
        ]

    def tie(self, position_rad: Floats) -> None:
        """Set the joints that follow others, in place."""
        for joint, of, factor in self._mirrors:
            position_rad[joint] = position_rad[of] * factor

    def spare(self, start: Floats, goal: Floats) -> Floats:
        """How much room is to be left to each range that narrows, shape (ranges,) [rad]: no more than the ends have."""
        ends = np.stack((start, goal))
        return np.array([min(_INSIDE_RAD, max(0.0, float(one.room_rad(ends).min()))) for one in self._narrowed])

    def keeps(self, start: Floats, end: Floats, spare: Floats) -> bool:
        """Whether a straight way stays where others leave each joint room, with so much to spare [rad]."""
        return all(
            bool(np.all(one.room_rad(one.places(start, end)) >= least - _SAME_RAD))
            for one, least in zip(self._narrowed, spare.tolist(), strict=True)
        )
