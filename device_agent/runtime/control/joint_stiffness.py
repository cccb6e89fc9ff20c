"""Stiffness of each joint. A compliant joint is commanded to its measured position, so that it does not jump later."""

from collections.abc import Iterable, Mapping, Sequence

from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.errors import Refused


class JointStiffness:
    """Joint stiffness of one device. Not thread-safe: the controller locks.

    Attributes:
        limited: Compliant joints, as telemetry names them.
        soft: Indices of the joints with reduced stiffness.
    """

    def __init__(self, robot_type: RobotType) -> None:
        self._joints = robot_type.joints
        self._index = {joint.name: index for index, joint in enumerate(robot_type.joints)}
        self._values: dict[str, float] = {}
        self._compliant: tuple[int, ...] = ()
        self.limited: tuple[str, ...] = ()
        self.soft: frozenset[int] = frozenset()

    @property
    def values(self) -> Mapping[str, float]:
        """Joint → stiffness, of the joints with reduced stiffness."""
        return self._values

    def resolve_names(self, joints: Sequence[str]) -> tuple[str, ...]:
        """These joints, or all joints if none is named.

        Raises:
            Refused: A joint is unknown.
        """
        for name in joints:
            if name not in self._index:
                raise Refused("unknown_joint", f"no joint '{name[:80]}'; there are {', '.join(self._index)}")
        return tuple(joints) or tuple(self._index)

    def of(self, joints: Sequence[str]) -> dict[str, float]:
        """Stiffness of these joints, or of all, 0…1. Raises ``Refused`` if a joint is unknown."""
        return {name: self._values.get(name, 1.0) for name in self.resolve_names(joints)}

    def set(self, values: Mapping[str, float]) -> None:
        """Set the stiffness of joints, 0…1."""
        merged = {**self._values, **values}
        # In the order of the robot type, so that equal values have one representation.
        self._values = {name: merged[name] for name in self._index if merged.get(name, 1.0) < 1.0}
        self.soft = frozenset(self._index[name] for name in self._values)
        self._compliant = tuple(self._index[name] for name, value in self._values.items() if value <= 0)
        self.limited = tuple(f"{self._joints[index].name}: compliant" for index in self._compliant)

    def check_movable(self, moved: Iterable[str]) -> None:
        """Check that no joint of a goal is compliant.

        Raises:
            Refused: A joint is compliant.
        """
        compliant = [name for name in moved if self._values.get(name, 1.0) <= 0]
        if compliant:
            raise Refused("compliant", f"{', '.join(compliant)}: no stiffness; set a stiffness above 0 first")

    def track(self, measured_rad: Sequence[float]) -> dict[int, float]:
        """Index → commanded position of each compliant joint: its measured position, clamped to its range [rad]."""
        return {
            index: min(max(measured_rad[index], self._joints[index].lower_rad), self._joints[index].upper_rad)
            for index in self._compliant
        }
