"""Driver of one robot with LeRobot. ``device_agent/ports/driver.py`` documents each method."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from device_agent.drivers.command_limits import limit_positions, limit_twist
from device_agent.drivers.lerobot.connection import Connection, Settings, Status
from device_agent.ports.driver import DriverError, DriverFault, Observation, Twist, UnreachableError
from device_agent.protocol import Twin
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.robot_model import RobotModel

HOT_C = 60.0
"""Temperature of a servo that is reported [°C]. Servos switch themselves off at 70 °C (STS3215) or 72 °C (X series)."""
LOST_SHARE = 0.05
"""Share of lost responses that is reported."""


class LerobotDriver:
    """Drives the joints of one robot.

    Args:
        robot_type: Joints with LeRobot's names, and limits. A closed gripper is at its lower limit.
        folder: Folder of the robot type, for its model.
        options: Options of the driver.
        device: Id of the device at its agent.
    """

    def __init__(self, robot_type: RobotType, folder: Path, *, options: Mapping[str, str], device: str) -> None:
        joints = robot_type.joints
        self._type = robot_type
        self._settings = Settings(
            robot=options["robot"],
            port=options["port"],
            id=options["id"],
            calibration=options.get("calibration", ""),
            python=options["python"],
            joints=tuple(joint.name for joint in joints),
            velocity_rad_s=tuple(joint.max_velocity_rad_s for joint in joints),
            closed_rad=tuple(joint.lower_rad for joint in joints),
            base=robot_type.base is not None,
        )
        self._model = RobotModel(robot_type, folder)
        self._device = device
        self._connection: Connection | None = None
        self._halted = False

    @property
    def simulated(self) -> bool:
        """Always False: this device is real."""
        return False

    def connect(self) -> None:
        """Start the bridge, which makes the robot hold, and wait for the first measurement."""
        self.close()
        self._connection = Connection(self._settings, self._device)
        self._halted = False

    def twin(self) -> Twin | None:
        """The model of the robot type; it needs no connection."""
        return self._model.twin(self._device)

    def observe(self) -> Observation:
        """The newest measurement. The servos measure no torques: the efforts are 0."""
        connection = self._connected()
        newest = connection.measurement
        return Observation(
            newest.position_rad,
            connection.velocity_rad_s,
            (0.0,) * len(newest.position_rad),
            self._model.frames(newest.position_rad),
            at_s=newest.at_s,
        )

    def faults(self) -> tuple[DriverFault, ...]:
        """Errors of servos, servos without torque, hot servos, and lost responses."""
        connection = self._connection
        if connection is None or connection.status is None:
            return ()
        return self._faults(connection, connection.status)

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command positions within the limits of the joints and the calibrated ranges."""
        connection = self._free()
        limited = zip(connection.units, limit_positions(self._type, position_rad), strict=True)
        applied = tuple(unit.limit(position) for unit, position in limited)
        connection.send(values=[unit.from_rad(v) for unit, v in zip(connection.units, applied, strict=True)])
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: temperature and voltage of each servo; ``odometry``: measured velocity of the base."""
        connection = self._connection
        if connection is None or connection.status is None:
            return {}
        status, motors = connection.status, connection.motors
        if stream == "health":
            temperatures = {
                f"temperature_c.{name}": float(c) for name, c in zip(motors, status.temperature, strict=True)
            }
            return temperatures | {f"voltage_v.{name}": v / 10 for name, v in zip(motors, status.voltage, strict=True)}
        if stream == "odometry" and self._settings.base:
            return connection.measurement.twist._asdict()
        return {}

    def halt(self) -> None:
        """Stop the base and hold the measured position."""
        self._halted = True
        connection = self._connection
        if connection is not None:
            connection.send(hold=True)

    def close(self) -> None:
        """End the bridge, which stops the robot. The servos keep their torque."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _connected(self) -> Connection:
        if self._connection is None:
            raise UnreachableError(f"'{self._device}' is not connected")
        return self._connection

    def _free(self) -> Connection:
        """The connection to a robot that may move.

        Raises:
            DriverError: It is halted, lost, or has stopped itself.
        """
        connection = self._connected()
        if self._halted:
            raise DriverError("the robot was halted; it reconnects")
        if connection.measurement is None or connection.status is None:
            raise UnreachableError("the robot's status is unknown")
        for fault in self._faults(connection, connection.status):
            if fault.stops:
                raise DriverError(f"the robot has stopped itself: {fault.message}")
        return connection

    def _faults(self, connection: Connection, status: Status) -> tuple[DriverFault, ...]:
        motors, faults = connection.motors, []
        names = [connection.robot.servos.errors(bits) for bits in status.errors]
        errors = [f"{motor} ({', '.join(texts)})" for motor, texts in zip(motors, names, strict=True) if texts]
        if errors:
            message = f"errors of servos: {'; '.join(errors)}; relieve the robot, then switch its power off and on"
            faults.append(DriverFault("servo-error", message))
        limp = [name for name, torque in zip(motors, status.torque, strict=True) if not torque]
        if limp:
            message = f"no torque: {', '.join(limp)}; support the robot, then switch its power off and on"
            faults.append(DriverFault("torque-off", message))
        hot = [f"{name} {c} °C" for name, c in zip(motors, status.temperature, strict=True) if c >= HOT_C]
        if hot:
            message = f"servos are hot: {', '.join(hot)}; let them cool down in a rest position"
            faults.append(DriverFault("servo-hot", message, stops=False))
        if status.lost > LOST_SHARE:
            message = f"{status.lost:.0%} of the servos' responses are lost; check the cables"
            faults.append(DriverFault("communication", message, stops=False))
        return tuple(faults)


class LerobotMobileDriver(LerobotDriver):
    """Drives joints and the base of one robot."""

    def drive(self, twist: Twist) -> Twist:
        """Drive with a velocity within the limits of the base."""
        connection = self._free()
        applied = limit_twist(self._type, twist)
        connection.send(twist=(applied.forward_m_s, applied.left_m_s, math.degrees(applied.turn_rad_s)))
        return applied
