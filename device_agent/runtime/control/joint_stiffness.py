"""How firmly joints hold. What is limp is commanded to where it is, so that it does not jump when it holds again."""

from collections.abc import Iterable, Mapping, Sequence

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused


class JointStiffness:
    """The stiffness of each joint of one device. Not thread-safe: its owner locks.

    Args:
        robot_type: Joints and their ranges.

    Attributes:
        limited: Which joints are limp, as telemetry names it.
        soft: Indices of the joints that hold with less than all their strength.
    """

    def __init__(self, robot_type: RobotType) -> None:
        self._joints = robot_type.joints
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._values: dict[str, float] = {}
        self._limp: tuple[int, ...] = ()
        self.limited: tuple[str, ...] = ()
        self.soft: frozenset[int] = frozenset()

    @property
    def values(self) -> Mapping[str, float]:
        """Joint → share of its strength, of those that do not hold with all of it."""
        return self._values

    def named(self, joints: Sequence[str]) -> tuple[str, ...]:
        """These joints; all of them where none is named.

        Raises:
            Refused: There is no such joint.
        """
        for name in joints:
            if name not in self._index:
                raise Refused("unknown_joint", f"no joint '{name[:80]}'; there are {', '.join(self._index)}")
        return tuple(joints) or tuple(self._index)

    def set(self, values: Mapping[str, float]) -> None:
        """From now on these joints hold so firmly, 0…1."""
        known = {**self._values, **values}
        # In the type's order, so that the same stiffness is always shown the same.
        self._values = {name: known[name] for name in self._index if known.get(name, 1.0) < 1.0}
        self.soft = frozenset(self._index[name] for name in self._values)
        self._limp = tuple(self._index[name] for name, value in self._values.items() if value <= 0)
        self.limited = tuple(f"{self._joints[index].name}: limp" for index in self._limp)

    def check(self, moved: Iterable[str]) -> None:
        """No joint that is to move is limp.

        Raises:
            Refused: One is.
        """
        limp = [name for name in moved if self._values.get(name, 1.0) <= 0]
        if limp:
            raise Refused("limp", f"{', '.join(limp)}: limp; set a stiffness above 0 first")

    def feel(self, measured_rad: Sequence[float]) -> dict[int, float]:
        """Where limp joints are to be commanded: to where they are, inside of their ranges."""
        return {
            index: min(max(measured_rad[index], self._joints[index].lower_rad), self._joints[index].upper_rad)
            for index in self._limp
        }
