"""Driver of the template's device. ``device_agent/ports/driver.py`` documents each method."""

import math
from collections.abc import Sequence
from pathlib import Path

from device_agent.drivers.command_limits import limit_positions
from device_agent.drivers.testing.template.connection import Connection
from device_agent.ports.driver import DriverError, DriverFault, Observation, UnreachableError
from device_agent.protocol import Twin
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.robot_model import RobotModel

_NORMAL = "normal"


class TemplateDriver:
    """Drives the joints of one device.

    Args:
        robot_type: Joints, limits and frames.
        folder: Folder of the robot type, for its model.
        address: Host and port of the device.
        device: Id of the device at its agent.
    """

    def __init__(self, robot_type: RobotType, folder: Path, address: tuple[str, int], device: str) -> None:
        self._type = robot_type
        self._names = [joint.name for joint in robot_type.joints]
        self._model = RobotModel(robot_type, folder)
        self._address = address
        self._device = device
        self._connection: Connection | None = None
        self._halted = False

    @property
    def simulated(self) -> bool:
        """Always False: this device is real."""
        return False

    def connect(self) -> None:
        """Connect, and wait for the first measurement; the device holds its position."""
        self.close()
        self._connection = Connection(self._address, self._names, self._device)
        self._connection.send({"hold": True})
        self._halted = False

    def twin(self) -> Twin | None:
        """The model of the robot type; it needs no connection."""
        return self._model.twin(self._device)

    def observe(self) -> Observation:
        """The newest measurement."""
        newest = self._connected().measurement
        return Observation(
            newest.position_rad,
            newest.velocity_rad_s,
            newest.effort_nm,
            self._model.frames(newest.position_rad),
            at_s=newest.at_s,
        )

    def faults(self) -> tuple[DriverFault, ...]:
        """A fault in every safety mode but the normal one."""
        newest = None if self._connection is None else self._connection.newest
        if newest is None or newest.safety == _NORMAL:
            return ()
        return (
            DriverFault("protective-stop", f"the device is in the safety mode '{newest.safety}'; release it there"),
        )

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command positions within the limits of the joints."""
        connection = self._free()
        applied = limit_positions(self._type, position_rad)
        connection.send({"names": self._names, "position_deg": [math.degrees(value) for value in applied]})
        return applied

    def halt(self) -> None:
        """Hold at once; a lost device holds by itself."""
        self._halted = True
        connection = self._connection
        if connection is not None:
            connection.send({"hold": True})

    def close(self) -> None:
        """End the connection."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _connected(self) -> Connection:
        if self._connection is None:
            raise UnreachableError(f"'{self._device}' is not connected")
        return self._connection

    def _free(self) -> Connection:
        """The connection, if the device may move.

        Raises:
            DriverError: It is halted, lost, or has stopped itself.
        """
        connection = self._connected()
        if self._halted:
            raise DriverError("the device was halted; it reconnects")
        if connection.measurement.safety != _NORMAL:
            raise DriverError(f"the device has stopped itself: {connection.measurement.safety}")
        return connection
