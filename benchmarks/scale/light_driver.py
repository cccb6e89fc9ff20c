"""A driver without physics: the arm is always at its commanded position. The rest is the cost of the agent."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from device_agent.ports.driver import Observation
from device_agent.protocol import Pose, Twin
from device_agent.protocol.manifests.robot_type import RobotType

_POSE: Final[Pose] = (0.123456, 0.234567, 0.345678, 0.707107, 0.0, 0.707107, 0.0)


class LightArm:
    """A ``Driver`` with joints only."""

    simulated = True

    def __init__(self, kind: RobotType) -> None:
        self._position_rad = tuple(kind.home_rad[joint.name] for joint in kind.joints)
        self._zeros = (0.0,) * len(kind.joints)
        self._frames = (_POSE,) * len(kind.frames)

    def connect(self) -> None:
        """Implements the port."""

    def twin(self) -> Twin | None:
        """Implements the port; there is no drawing."""
        return None

    def observe(self) -> Observation:
        """Implements the port."""
        return Observation(self._position_rad, self._zeros, self._zeros, self._frames)

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Implements the port."""
        self._position_rad = tuple(position_rad)
        return self._position_rad

    def halt(self) -> None:
        """Implements the port; the arm does not move by itself."""

    def close(self) -> None:
        """Implements the port."""


def create(robot_type: RobotType, _folder: Path, _options: Mapping[str, object], _device: str) -> LightArm:
    """Creates the driver for ``drivers.load``."""
    return LightArm(robot_type)
