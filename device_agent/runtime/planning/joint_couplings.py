"""Joint couplings: mimic joints, and joints whose range depends on the position of another joint.

Coupled joints stay in a box that is safe in any order and at any speed. A joint with a narrowing range stays within the
range that remains on the whole path of the other joint. The other joint waits until the first one is out of its way.
Therefore neither braking nor a late period leaves the box.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from device_agent.protocol.manifests.capabilities import PositionDependentLimit
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.planning.trajectory import Floats

_SAME_RAD = 1e-6
_MIMIC_TOLERANCE_RAD = 1e-3
_BISECTIONS = 24


class _Mirror(NamedTuple):
    """``joint`` is at ``factor`` times the position of ``of``; both are indices."""

    joint: int
    of: int
    factor: float


@dataclass(frozen=True, slots=True)
class _DependentRange:
    """The range of ``joint`` depends on the position of ``by``; both are indices."""

    joint: int
    by: int
    rule: PositionDependentLimit

    def common_range(self, *positions: float) -> tuple[float, float]:
        """The range that is valid for all positions of ``by`` between some positions; empty if lower exceeds upper."""
        low, high = min(positions), max(positions)
        ranges = [self.rule.at(low), self.rule.at(high)]
        ranges += [row[1:] for row in self.rule.table if low < row[0] < high]
        return max(lower for lower, _ in ranges), min(upper for _, upper in ranges)

    def reachable(self, start: float, end: float, by_swing: tuple[float, float], swing: tuple[float, float]) -> float:
        """The position nearest to ``end`` that ``by`` can reach while ``swing`` of ``joint`` stays in its range."""

        def fits(share: float) -> bool:
            lower, upper = self.common_range(*by_swing, start + share * (end - start))
            return lower - _SAME_RAD <= swing[0] and swing[1] <= upper + _SAME_RAD

        if fits(1.0):
            return end
        clear, blocked = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = (clear + blocked) / 2
            clear, blocked = (middle, blocked) if fits(middle) else (clear, middle)
        return start + clear * (end - start)


class Couplings:
    """Joint couplings of a robot type. Stateless; positions are in the type's order, shape (n,)."""

    def __init__(self, robot_type: RobotType) -> None:
        self._names = [joint.name for joint in robot_type.joints]
        index = {name: number for number, name in enumerate(self._names)}
        self._mirrors = [
            _Mirror(index[mimic.joint], index[mimic.mimics], mimic.multiplier) for mimic in robot_type.mimic_joints
        ]
        self._followers = {mimic.joint: mimic for mimic in robot_type.mimic_joints}
        self._dependent = [
            _DependentRange(index[rule.joint], index[rule.depends_on], rule)
            for rule in robot_type.position_dependent_limits
        ]

    def __bool__(self) -> bool:
        """Whether any joints are coupled."""
        return bool(self._mirrors or self._dependent)

    def resolve_leaders(self, position_rad: Mapping[str, float]) -> tuple[Mapping[str, float], tuple[str, ...]]:
        """Positions without mimic joints, and the mimic joints whose requested positions contradict their leaders."""
        if not self._mirrors or self._followers.keys().isdisjoint(position_rad):
            return position_rad, ()
        leaders: dict[str, float] = {}
        differing = []
        for name, value in position_rad.items():
            mirror = self._followers.get(name)
            if mirror is None:
                leaders[name] = value
            elif mirror.mimics not in position_rad:
                leaders[mirror.mimics] = value / mirror.multiplier
            elif abs(value - position_rad[mirror.mimics] * mirror.multiplier) > _SAME_RAD:
                differing.append(name)
        return leaders, tuple(differing)

    def apply_mirrors(self, values: list[float]) -> None:
        """Set positions, velocities or accelerations of mimic joints."""
        for joint, of, factor in self._mirrors:
            values[joint] = values[of] * factor

    def find_violations(self, position_rad: Sequence[float]) -> list[tuple[int, float, float, str]]:
        """The joints outside their dependent range: index, lower, upper, name of the other joint."""
        violations = []
        for dependent in self._dependent:
            lower, upper = dependent.rule.at(position_rad[dependent.by])
            if not lower <= position_rad[dependent.joint] <= upper:
                violations.append((dependent.joint, lower, upper, dependent.rule.depends_on))
        return violations

    def confine(self, position_rad: Floats) -> None:
        """Move a path, shape (samples, n) [rad], into the allowed ranges, in place."""
        for dependent in self._dependent:
            by, lower, upper = np.array(dependent.rule.table).T
            by_rad, joint_rad = position_rad[:, dependent.by], position_rad[:, dependent.joint]
            joint_rad[:] = np.clip(joint_rad, np.interp(by_rad, by, lower), np.interp(by_rad, by, upper))
        for joint, of, factor in self._mirrors:
            position_rad[:, joint] = position_rad[:, of] * factor

    def describe_violation(self, position_rad: Floats) -> str:
        """How a path, shape (samples, n) [rad], violates the couplings; empty if it does not."""
        for joint, of, factor in self._mirrors:
            if np.any(np.abs(position_rad[:, joint] - position_rad[:, of] * factor) > _MIMIC_TOLERANCE_RAD):
                return f"separates {self._names[joint]} from {self._names[of]}, which the same motor moves"
        for dependent in self._dependent:
            by, lower, upper = np.array(dependent.rule.table).T
            by_rad, joint_rad = position_rad[:, dependent.by], position_rad[:, dependent.joint]
            low, high = np.interp(by_rad, by, lower), np.interp(by_rad, by, upper)
            if np.any((joint_rad < low - _SAME_RAD) | (joint_rad > high + _SAME_RAD)):
                return f"leads {self._names[dependent.joint]} where {dependent.rule.depends_on} does not allow it"
        return ""

    def limit_target(
        self, target_rad: Sequence[float], position_rad: Sequence[float], swing_rad: Sequence[tuple[float, float]]
    ) -> tuple[list[float], tuple[str, ...]]:
        """The target for this period, so that the path to the final target stays inside the allowed ranges.

        Args:
            target_rad: Final target, inside the range that applies there.
            position_rad: Present positions.
            swing_rad: Lowest and highest position of each joint if it slowed down from now on.

        Returns:
            The target for now, and the waiting joints, as ``limited`` names them.
        """
        limited, waits = list(target_rad), []
        for dependent in self._dependent:
            joint, by = dependent.joint, dependent.by
            end = target_rad[by]
            lower, upper = dependent.common_range(*swing_rad[by], end)
            if lower > upper:  # no position is valid for the whole path: go as far as one is, and continue from there
                end = dependent.reachable(position_rad[by], end, swing_rad[by], swing_rad[joint])
                lower, upper = dependent.common_range(*swing_rad[by], end)
            limited[joint] = min(max(target_rad[joint], lower), upper) if lower <= upper else position_rad[joint]
            limited[by] = dependent.reachable(position_rad[by], end, swing_rad[by], swing_rad[joint])
            if abs(limited[by] - target_rad[by]) > _SAME_RAD:
                waits.append(f"{self._names[by]}: waits for {self._names[joint]}")
        self.apply_mirrors(limited)
        return limited, tuple(waits)

    def clamp_to_range(self, position_rad: list[float], before_rad: Sequence[float]) -> None:
        """Clamp a command to the dependent ranges.

        A joint that was already outside, for example pushed by hand, may stay there but not move further out.
        """
        for dependent in self._dependent:
            before = before_rad[dependent.joint]
            lower, upper = dependent.rule.at(before_rad[dependent.by])
            inside = lower - _SAME_RAD <= before <= upper + _SAME_RAD
            lower, upper = dependent.rule.at(position_rad[dependent.by])
            if not inside:
                lower, upper = min(lower, before), max(upper, before)
            position_rad[dependent.joint] = min(max(position_rad[dependent.joint], lower), upper)
