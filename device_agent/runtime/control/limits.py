"""Motion limits: joint names, ranges, couplings and clearance. They apply to every source of motion."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from device_agent.ports.geometry import Clearance, RobotGeometry
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.joint_couplings import Couplings
from device_agent.runtime.planning.trajectory import Floats

_SAME_RAD = 1e-9


class MotionLimits:
    """Limits of one device's positions. Stateless."""

    def __init__(self, robot_type: RobotType, geometry: RobotGeometry | None) -> None:
        self._joints = robot_type.joints
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._couplings = Couplings(robot_type)
        self._geometry = geometry
        shape = (
            () if geometry is None else ("clearance",) if robot_type.workspace is None else ("clearance", "workspace")
        )
        self.names = ("position", "velocity", "acceleration", "jerk", *shape)

    def check(self, position_rad: Mapping[str, float]) -> None:
        """Check that all joints are known and all positions are finite.

        Raises:
            Refused: They are not.
        """
        unknown = sorted(set(position_rad) - set(self._index))
        if unknown:
            raise Refused("unknown_joint", f"no joint '{unknown[0][:80]}'; there are {', '.join(self._index)}")
        if not all(map(math.isfinite, position_rad.values())):
            raise Refused("not_finite", "a position must be a finite number")

    def clamp(self, position_rad: Mapping[str, float], target_rad: list[float]) -> tuple[str, ...]:
        """Write positions, clamped to their ranges, into ``target_rad``.

        Returns:
            The clamped joints, as ``limited`` names them.
        """
        leaders, differing = self._couplings.resolve_leaders(position_rad)
        limited = [f"{name}: mirror" for name in differing]
        for name, value in leaders.items():
            index = self._index[name]
            joint = self._joints[index]
            target_rad[index] = min(max(value, joint.lower_rad), joint.upper_rad)
            if target_rad[index] != value:
                limited.append(f"{name}: range")
        self._couplings.apply_mirrors(target_rad)
        for index, lower, upper, by in self._couplings.find_violations(target_rad):
            target_rad[index] = min(max(target_rad[index], lower), upper)
            limited.append(f"{self._joints[index].name}: range at {by}")
        return tuple(limited)

    def resolve_target(self, position_rad: Mapping[str, float], current_rad: Sequence[float]) -> list[float]:
        """Final positions of a joint goal, shape (n,) [rad].

        Joints without a position stay, except joints whose range the others narrow.

        Raises:
            Refused: Unknown joint, position not finite or out of range, or no clearance there.
        """
        self.check(position_rad)
        leaders, differing = self._couplings.resolve_leaders(position_rad)
        if differing:
            raise Refused("mirrored", f"one motor moves {differing[0]} and another joint; give only one of the two")
        target = list(current_rad)
        for name, value in leaders.items():
            joint = self._joints[self._index[name]]
            if not joint.lower_rad <= value <= joint.upper_rad:
                raise Refused(
                    "out_of_range",
                    f"{name} can go from {joint.lower_rad:.4f} to {joint.upper_rad:.4f} rad, not to {value:.4f}",
                )
            target[self._index[name]] = value
        self._couplings.apply_mirrors(target)
        for index, lower, upper, by in self._couplings.find_violations(target):
            name = self._joints[index].name
            if name in leaders:
                raise Refused(
                    "out_of_range",
                    f"{name} can go from {lower:.4f} to {upper:.4f} rad at the target of {by}, "
                    f"not to {target[index]:.4f}",
                )
            target[index] = min(max(target[index], lower), upper)
        if self._geometry is not None:
            clearance = self._geometry.clearance(target)
            # A robot that is already too close to an obstacle may move to a position with more clearance.
            if clearance.excess_m < min(0.0, self._geometry.clearance(current_rad).excess_m):
                short_mm = math.ceil(-clearance.excess_m * 1000)
                raise Refused(
                    "no_room", f"no clearance at the target: {clearance.text}, {short_mm} mm too close; choose another"
                )
        return target

    def check_trajectory(self, position_rad: Floats) -> None:
        """Check that a trajectory, shape (samples, n) [rad], stays inside the joints' ranges.

        Raises:
            Refused: It does not.
        """
        lower = np.array([joint.lower_rad for joint in self._joints]) - _SAME_RAD
        upper = np.array([joint.upper_rad for joint in self._joints]) + _SAME_RAD
        outside = ~np.all((position_rad >= lower) & (position_rad <= upper), axis=0)  # true for NaN
        if np.any(outside):
            joint = self._joints[int(np.argmax(outside))]
            raise Refused("out_of_range", f"the trajectory leads {joint.name} out of its range")
        violation = self._couplings.describe_violation(position_rad)
        if violation:
            raise Refused("out_of_range", f"the trajectory {violation}")

    def find_obstacle(self, path_rad: Sequence[Sequence[float]]) -> Clearance | None:
        """The obstacle on a path, if any."""
        if self._geometry is None or all(position == path_rad[0] for position in path_rad):
            return None
        return self._geometry.sweep(path_rad).clearance
