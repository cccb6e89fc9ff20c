"""Driver of a device that also has a mobile base, whose velocity continues until the next command."""

import contextlib
from pathlib import Path

from device_agent.drivers.command_limits import limit_twist
from device_agent.drivers.testing.template.driver import TemplateDriver
from device_agent.drivers.watchdog import CommandWatchdog
from device_agent.ports.driver import REST, Twist, UnreachableError
from device_agent.protocol.manifests.robot_type import RobotType


class TemplateBaseDriver(TemplateDriver):
    """As ``TemplateDriver``, with a base. A watchdog brakes it, because the device itself has none."""

    def __init__(self, robot_type: RobotType, folder: Path, address: tuple[str, int], device: str) -> None:
        super().__init__(robot_type, folder, address, device)
        self._watchdog = CommandWatchdog(self._brake, device=device)

    def connect(self) -> None:
        """Connect; the base is at rest."""
        super().connect()
        self._brake()
        self._watchdog.start()

    def drive(self, twist: Twist) -> Twist:
        """Command a velocity within the limits of the base."""
        connection = self._free()
        applied = limit_twist(self._type, twist)
        connection.send({"velocity": list(applied)})
        self._watchdog.feed()
        return applied

    def halt(self) -> None:
        """Hold the joints and brake the base."""
        super().halt()
        self._brake()

    def close(self) -> None:
        """Brake, and end the connection."""
        self._watchdog.stop()
        with contextlib.suppress(UnreachableError):
            self._brake()
        super().close()

    def _brake(self) -> None:
        connection = self._connection
        if connection is not None:
            connection.send({"velocity": list(REST)})
