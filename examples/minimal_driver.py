"""A driver plug-in for a robot whose motors reach every position immediately.

Publish it in a package with the entry point ``minimal = "minimal_driver:create"`` in the group ``telescope.drivers``,
and select it with ``driver = "minimal"`` in ``agent.toml``. ``device_agent/ports/driver.py`` documents each method.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from device_agent.ports.driver import Driver, DriverError, Observation
from device_agent.protocol.manifests.robot_type import RobotType


class MinimalDriver:
    """Stores the commanded positions and reports them as measured."""

    def __init__(self, robot_type: RobotType) -> None:
        self._joints = robot_type.joints
        self._frames = len(robot_type.frames)
        self._position_rad = tuple(robot_type.home_rad[joint.name] for joint in robot_type.joints)
        self._connected = False
        self._halted = False

    @property
    def simulated(self) -> bool:
        return True

    def connect(self) -> None:
        self._connected = True
        self._halted = False

    def twin(self) -> None:
        return None

    def observe(self) -> Observation:
        self._require_connection()
        zeros = (0.0,) * len(self._position_rad)
        return Observation(self._position_rad, zeros, zeros, ((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),) * self._frames)

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Apply the positions within the joint ranges and return what was applied [rad]."""
        self._require_connection()
        if self._halted:
            raise DriverError("the device was halted; reconnect")
        if len(position_rad) != len(self._joints) or not all(map(math.isfinite, position_rad)):
            raise DriverError(f"expected {len(self._joints)} finite positions")
        self._position_rad = tuple(
            min(max(value, joint.lower_rad), joint.upper_rad)
            for value, joint in zip(position_rad, self._joints, strict=True)
        )
        return self._position_rad

    def halt(self) -> None:
        self._halted = True

    def close(self) -> None:
        self._connected = False

    def _require_connection(self) -> None:
        if not self._connected:
            raise DriverError("the driver is not connected")


def create(robot_type: RobotType, folder: Path, options: Mapping[str, Any], device: str) -> Driver:
    """Entry point. The agent calls it once for each device that selects this driver."""
    del folder, device
    if options:
        raise DriverError(f"driver 'minimal' has no options; remove {', '.join(options)}")
    return MinimalDriver(robot_type)
