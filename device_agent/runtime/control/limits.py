"""What the robot type and the robot's shape allow: names, ranges, room. The same for every source of motion."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from device_agent.ports.geometry import Clearance, RobotGeometry
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning.joint_couplings import Couplings

Floats = npt.NDArray[np.float64]

_SAME_RAD = 1e-9


class MotionLimits:
    """The limits of one device's positions. Keeps nothing, moves nothing.

    Args:
        robot_type: Joints and their ranges.
        geometry: The robot's shape; without it nobody knows what it could touch, and only ranges hold.

    Attributes:
        limits: What is held, by name.
    """

    def __init__(self, robot_type: RobotType, geometry: RobotGeometry | None) -> None:
        self._joints = robot_type.joints
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._couplings = Couplings(robot_type)
        self._geometry = geometry
        shape = (
            () if geometry is None else ("clearance",) if robot_type.workspace is None else ("clearance", "workspace")
        )
        self.limits = ("position", "velocity", "acceleration", "jerk", *shape)

    def check(self, position_rad: Mapping[str, float]) -> None:
        """All joints are known, all numbers are numbers.

        Raises:
            Refused: They are not.
        """
        unknown = sorted(set(position_rad) - set(self._index))
        if unknown:
            raise Refused("unknown_joint", f"no joint '{unknown[0][:80]}'; there are {', '.join(self._index)}")
        if not all(map(math.isfinite, position_rad.values())):
            raise Refused("not_finite", "a position must be a finite number")

    def clamp(self, position_rad: Mapping[str, float], target_rad: list[float]) -> tuple[str, ...]:
        """Write positions into a target, each inside its range.

        Returns:
            The joints that were asked beyond it, as ``limited`` names them.
        """
        led, differing = self._couplings.lead(position_rad)
        limited = [f"{name}: mirror" for name in differing]
        for name, value in led.items():
            index = self._index[name]
            joint = self._joints[index]
            target_rad[index] = min(max(value, joint.lower_rad), joint.upper_rad)
            if target_rad[index] != value:
                limited.append(f"{name}: range")
        self._couplings.tie(target_rad)
        for index, lower, upper, by in self._couplings.narrowed(target_rad):
            target_rad[index] = min(max(target_rad[index], lower), upper)
            limited.append(f"{self._joints[index].name}: range at {by}")
        return tuple(limited)

    def target(self, position_rad: Mapping[str, float], now_rad: Sequence[float]) -> list[float]:
        """Where a move to these positions ends, shape (n,) [rad].

        Joints not named stay, but for those to which the others leave no room where they are.

        Raises:
            Refused: Unknown joint, a number that is none, outside a joint's range, or no room there.
        """
        self.check(position_rad)
        led, differing = self._couplings.lead(position_rad)
        if differing:
            raise Refused("mirrored", f"one motor moves {differing[0]} and another joint; ask for one of the two")
        target = list(now_rad)
        for name, value in led.items():
            joint = self._joints[self._index[name]]
            if not joint.lower_rad <= value <= joint.upper_rad:
                raise Refused(
                    "out_of_range",
                    f"{name} can go from {joint.lower_rad:.4f} to {joint.upper_rad:.4f} rad, not to {value:.4f}",
                )
            target[self._index[name]] = value
        self._couplings.tie(target)
        for index, lower, upper, by in self._couplings.narrowed(target):
            name = self._joints[index].name
            if name in led:
                raise Refused(
                    "out_of_range",
                    f"{name} can go from {lower:.4f} to {upper:.4f} rad where {by} is then, not to {target[index]:.4f}",
                )
            target[index] = min(max(target[index], lower), upper)
        if self._geometry is not None:
            there = self._geometry.clearance(target)
            # Whoever is too near something already may go to where there is more room.
            if there.room_m < min(0.0, self._geometry.clearance(now_rad).room_m):
                short_mm = math.ceil(-there.room_m * 1000)
                raise Refused("no_room", f"no room there: {there.text}, {short_mm} mm too near; choose another")
        return target

    def check_way(self, position_rad: Floats) -> None:
        """All of a way is inside the joints' ranges, shape (places, n) [rad].

        Raises:
            Refused: It is not.
        """
        lower = np.array([joint.lower_rad for joint in self._joints]) - _SAME_RAD
        upper = np.array([joint.upper_rad for joint in self._joints]) + _SAME_RAD
        outside = ~np.all((position_rad >= lower) & (position_rad <= upper), axis=0)  # true for NaN
        if np.any(outside):
            joint = self._joints[int(np.argmax(outside))]
            raise Refused("out_of_range", f"the way there leads {joint.name} out of its range")
        parted = self._couplings.parted(position_rad)
        if parted:
            raise Refused("out_of_range", f"the way there {parted}")

    def blocked(self, path_rad: Sequence[Sequence[float]]) -> Clearance | None:
        """What is in the way, if anything is."""
        if self._geometry is None or all(position == path_rad[0] for position in path_rad):
            return None
        return self._geometry.sweep(path_rad).clearance
