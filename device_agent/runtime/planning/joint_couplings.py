"""Joints that hang together: one motor moves two of them, or the range of one depends on where another is.

Whatever the joints are on their way to, they stay in a box that is safe in any order and at any pace: the one whose
range narrows goes no farther than all of the other's way leaves it, and the other waits where the first is not yet
out of its way. So neither a brake nor a period that comes late leads out of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from device_agent.protocol.manifests.capabilities import PositionDependentLimit
from device_agent.protocol.manifests.robot_type import RobotType

Floats = npt.NDArray[np.float64]

_SAME_RAD = 1e-6
_TIED_RAD = 1e-3
_HALVINGS = 24


class _Mirror(NamedTuple):
    """``joint`` is at ``factor`` times the position of ``of``; both are indices."""

    joint: int
    of: int
    factor: float


@dataclass(frozen=True, slots=True)
class _Narrowed:
    """The range of ``joint`` depends on ``by``; both are indices."""

    joint: int
    by: int
    says: PositionDependentLimit

    def over(self, *places: float) -> tuple[float, float]:
        """What is inside of the range wherever ``by`` is between some positions; empty when lower exceeds upper."""
        low, high = min(places), max(places)
        ranges = [self.says.at(low), self.says.at(high)]
        ranges += [row[1:] for row in self.says.table if low < row[0] < high]
        return max(lower for lower, _ in ranges), min(upper for _, upper in ranges)

    def far(self, begin: float, end: float, by_swing: tuple[float, float], swing: tuple[float, float]) -> float:
        """How far ``by`` can go towards ``end`` with all that ``joint`` may come to inside of the range."""

        def fits(share: float) -> bool:
            lower, upper = self.over(*by_swing, begin + share * (end - begin))
            return lower - _SAME_RAD <= swing[0] and swing[1] <= upper + _SAME_RAD

        if fits(1.0):
            return end
        clear, blocked = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = (clear + blocked) / 2
            clear, blocked = (middle, blocked) if fits(middle) else (clear, middle)
        return begin + clear * (end - begin)


class Couplings:
    """How the joints of one robot type hang together. Keeps nothing; positions are in the type's order, shape (n,).

    Args:
        robot_type: With its ``mirrors`` and ``narrowing``.
    """

    def __init__(self, robot_type: RobotType) -> None:
        self._names = [joint.name for joint in robot_type.joints]
        index = {name: number for number, name in enumerate(self._names)}
        self._mirrors = [
            _Mirror(index[one.joint], index[one.mimics], one.multiplier) for one in robot_type.mimic_joints
        ]
        self._followers = {one.joint: one for one in robot_type.mimic_joints}
        self._narrowed = [
            _Narrowed(index[one.joint], index[one.depends_on], one) for one in robot_type.position_dependent_limits
        ]

    def __bool__(self) -> bool:
        """Whether any joint hangs together with another."""
        return bool(self._mirrors or self._narrowed)

    def lead(self, position_rad: Mapping[str, float]) -> tuple[Mapping[str, float], tuple[str, ...]]:
        """What is asked, of the joints that count alone; and which were asked to differ from those they mirror."""
        if not self._mirrors or self._followers.keys().isdisjoint(position_rad):
            return position_rad, ()
        led: dict[str, float] = {}
        differing = []
        for name, value in position_rad.items():
            mirror = self._followers.get(name)
            if mirror is None:
                led[name] = value
            elif mirror.mimics not in position_rad:
                led[mirror.mimics] = value / mirror.multiplier
            elif abs(value - position_rad[mirror.mimics] * mirror.multiplier) > _SAME_RAD:
                differing.append(name)
        return led, tuple(differing)

    def tie(self, values: list[float]) -> None:
        """Set the values of joints that mirror others: positions, velocities or accelerations."""
        for joint, of, factor in self._mirrors:
            values[joint] = values[of] * factor

    def narrowed(self, position_rad: Sequence[float]) -> list[tuple[int, float, float, str]]:
        """The joints that are out of the range that the others leave them: index, lower, upper, by which."""
        found = []
        for one in self._narrowed:
            lower, upper = one.says.at(position_rad[one.by])
            if not lower <= position_rad[one.joint] <= upper:
                found.append((one.joint, lower, upper, one.says.depends_on))
        return found

    def confine(self, position_rad: Floats) -> None:
        """Bring a way, shape (places, n) [rad], to where joints hang together, in place."""
        for one in self._narrowed:
            by, lower, upper = np.array(one.says.table).T
            there, place = position_rad[:, one.by], position_rad[:, one.joint]
            place[:] = np.clip(place, np.interp(there, by, lower), np.interp(there, by, upper))
        for joint, of, factor in self._mirrors:
            position_rad[:, joint] = position_rad[:, of] * factor

    def parted(self, position_rad: Floats) -> str:
        """Where a way, shape (places, n) [rad], would part joints that hang together; empty where it does not."""
        for joint, of, factor in self._mirrors:
            if np.any(np.abs(position_rad[:, joint] - position_rad[:, of] * factor) > _TIED_RAD):
                return f"parts {self._names[joint]} from {self._names[of]}, which the same motor moves"
        for one in self._narrowed:
            by, lower, upper = np.array(one.says.table).T
            there = position_rad[:, one.by]
            low, high = np.interp(there, by, lower), np.interp(there, by, upper)
            place = position_rad[:, one.joint]
            if np.any((place < low - _SAME_RAD) | (place > high + _SAME_RAD)):
                return f"leads {self._names[one.joint]} where {one.says.depends_on} leaves it no room"
        return ""

    def steer(
        self, target_rad: Sequence[float], position_rad: Sequence[float], swing_rad: Sequence[tuple[float, float]]
    ) -> tuple[list[float], tuple[str, ...]]:
        """Where to head now, so that the way to a target stays inside whatever the joints do on it.

        Args:
            target_rad: Where to come to rest, inside the range that is left there.
            position_rad: Where the joints are.
            swing_rad: The least and the most that each would come to if it slowed down from now on.

        Returns:
            The target for now, and what waits for what, as ``limited`` names it.
        """
        heading, waits = list(target_rad), []
        for one in self._narrowed:
            joint, by = one.joint, one.by
            end = target_rad[by]
            lower, upper = one.over(*swing_rad[by], end)
            if lower > upper:  # no one place does for all of the way: as far as one does, and on from there
                end = one.far(position_rad[by], end, swing_rad[by], swing_rad[joint])
                lower, upper = one.over(*swing_rad[by], end)
            heading[joint] = min(max(target_rad[joint], lower), upper) if lower <= upper else position_rad[joint]
            heading[by] = one.far(position_rad[by], end, swing_rad[by], swing_rad[joint])
            if abs(heading[by] - target_rad[by]) > _SAME_RAD:
                waits.append(f"{self._names[by]}: waits for {self._names[joint]}")
        self.tie(heading)
        return heading, tuple(waits)

    def keep(self, position_rad: list[float], before_rad: Sequence[float]) -> None:
        """The last word on a command: what left the range that was left to it goes back to its edge.

        Who was outside before (set up so, pushed by hand) may stay so, and go no farther.
        """
        for one in self._narrowed:
            before = before_rad[one.joint]
            lower, upper = one.says.at(before_rad[one.by])
            inside = lower - _SAME_RAD <= before <= upper + _SAME_RAD
            lower, upper = one.says.at(position_rad[one.by])
            if not inside:
                lower, upper = min(lower, before), max(upper, before)
            position_rad[one.joint] = min(max(position_rad[one.joint], lower), upper)
