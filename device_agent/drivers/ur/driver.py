"""Driver of one arm. ``device_agent/ports/driver.py`` documents each method."""

import contextlib
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from device_agent.drivers.command_limits import limit_positions
from device_agent.drivers.ur import modes, program
from device_agent.drivers.ur.behaviours import UrBehaviours
from device_agent.drivers.ur.connection import Connection, Measurement
from device_agent.drivers.ur.dashboard import Dashboard
from device_agent.drivers.ur.gripper import Gripper
from device_agent.drivers.ur.outputs import GRIPPER, IO, SETTINGS, UrOutputs
from device_agent.drivers.ur.starter import ProgramStarter
from device_agent.ports.driver import DriverError, DriverFault, Observation, UnreachableError
from device_agent.ports.skills import BehaviourContext, RobotBehaviour, SkillError
from device_agent.protocol import Control, Twin
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.robot_model import RobotModel

HEALTH = "health"
_RESTART_S = 5.0
_POLL_S = 0.005
ORDER = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
"""Joints in the controller's order."""


@dataclass(frozen=True, slots=True)
class Controller:
    """Where the controller is, and how fast it reports.

    Attributes:
        host: Host name or IP address.
        rtde_port: Port of RTDE.
        script_port: Port of the secondary interface, which takes programs.
        frequency_hz: Rate of measurements [Hz].
        dashboard_port: Port of the dashboard server.
        programs: Paths of the programs on the controller that operators may run.
        outputs: Digital outputs that operators may set, of ``outputs.OUTPUTS``.
        gripper_port: Port of the gripper's URCap; 0: no gripper.
    """

    host: str
    rtde_port: int
    script_port: int
    frequency_hz: float
    dashboard_port: int = 29999
    programs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    gripper_port: int = 0


class UrDriver:
    """Drives one arm by a program at its controller, which follows setpoints and has its own watchdog.

    It implements ``ReportsFaults``, ``ReportsStreams`` (stream ``health``) and ``HasBehaviours``: recoveries, and
    programs that are stored on the controller. ``effort_nm`` is the torque that the controller computes for the motion;
    contact forces are not included.

    Args:
        robot_type: Joints, limits and frames; its joints are those of ``ORDER``.
        folder: Folder of the robot type, for its model.
        controller: The controller.
        device: Id of the device at its agent.
    """

    def __init__(self, robot_type: RobotType, folder: Path, controller: Controller, device: str) -> None:
        self._type = robot_type
        self._names = [joint.name for joint in robot_type.joints]
        self._to_controller = [self._names.index(name) for name in ORDER]
        self._from_controller = [ORDER.index(name) for name in self._names]
        self._model = RobotModel(robot_type, folder)
        self._controller = controller
        self._device = device
        self._session = 0
        self._connection: Connection | None = None
        self._starter: ProgramStarter | None = None
        self._halted = False
        dashboard = Dashboard(controller.host, controller.dashboard_port)
        self._behaviours = UrBehaviours(dashboard, controller.programs, self._newest)
        gripper = Gripper(controller.host, controller.gripper_port) if controller.gripper_port else None
        self._outputs = UrOutputs(controller.outputs, gripper)
        streams = {stream.name for stream in robot_type.streams}
        self._measures_io = bool(controller.outputs) or IO in streams
        self._own = False  # whether a program of the controller moves the arm
        self._sends = 0

    @property
    def simulated(self) -> bool:
        """Always False, also at a controller that simulates its arm."""
        return False

    def connect(self) -> None:
        """Connect and start the program; the arm holds its position."""
        self.close()
        self._halted = False
        self._session = secrets.randbelow(2**31 - 1) + 1
        controller = self._controller
        self._connection = Connection(
            (controller.host, controller.rtde_port),
            session=self._session,
            frequency_hz=controller.frequency_hz,
            device=self._device,
            io=self._measures_io,
            banks=self._outputs.banks,
        )
        joints = [self._type.joints[index] for index in self._to_controller]
        script = program.script(
            self._session,
            max_velocity_rad_s=[joint.max_velocity_rad_s for joint in joints],
            max_acceleration_rad_s2=[joint.max_acceleration_rad_s2 for joint in joints],
            braking_rad_s2=self._type.braking_rad_s2,
        )
        self._starter = ProgramStarter(
            (controller.host, controller.script_port),
            script,
            session=self._session,
            connection=self._connection,
            device=self._device,
        )
        try:
            self._starter.wait()
        except UnreachableError:
            self.close()
            raise

    def twin(self) -> Twin | None:
        """The model of the robot type; it needs no connection."""
        return self._model.twin(self._device)

    def observe(self) -> Observation:
        """The newest measurement."""
        newest = self._connected().measurement
        position = self._ordered(newest.position_rad)
        return Observation(
            position,
            self._ordered(newest.velocity_rad_s),
            self._ordered(newest.effort_nm),
            self._model.frames(position),
            at_s=newest.at_s,
        )

    def faults(self) -> tuple[DriverFault, ...]:
        """Safety modes, modes of the arm, and a program that was ended or paused at the robot."""
        newest = None if self._connection is None else self._connection.newest
        fault = None if newest is None else self._fault(newest)
        return () if fault is None else (fault,)

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command positions within the limits of the joints."""
        self._sends += 1
        connection = self._free()
        if self._own:
            # The counter of setpoints shows a program that the agent is alive; our own program holds there.
            position = connection.measurement.position_rad
            connection.command(position)
            return self._ordered(position)
        applied = limit_positions(self._type, position_rad)
        connection.command([applied[index] for index in self._to_controller])
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: temperatures of the joints [°C], share of their torques; and the streams of ``UrOutputs``."""
        connection = self._connection
        newest = None if connection is None else connection.newest
        if newest is None or stream not in {HEALTH, IO, SETTINGS, GRIPPER}:
            return {}
        if stream != HEALTH:
            return self._outputs.report(stream, newest)
        values: dict[str, float | bool] = {}
        for joint, celsius, torque in zip(
            self._type.joints, self._ordered(newest.temperature_c), self._ordered(newest.effort_nm), strict=True
        ):
            values[f"temperature_c.{joint.name}"] = round(celsius, 2)
            values[f"load.{joint.name}"] = round(abs(torque) / joint.max_effort_nm, 3)
        return values

    @property
    def controls(self) -> tuple[Control, ...]:
        """The outputs that the owner permits, and the gripper."""
        return self._outputs.controls

    def set_control(self, name: str, value: float, context: BehaviourContext) -> float:
        """Set an output or move the gripper; returns the measured value."""
        try:
            return self._outputs.set(name, value, self._free(), context)
        except DriverError as error:
            raise SkillError(str(error)) from error

    @property
    def behaviours(self) -> tuple[RobotBehaviour, ...]:
        """The recoveries, and the programs that the owner permits."""
        return self._behaviours.all

    def run_behaviour(self, name: str, context: BehaviourContext) -> None:
        """Execute a recovery; or run a program of the controller, then start the agent's program again."""
        path = self._behaviours.program(name)
        if path is None:
            self._behaviours.recover(name, context)
            return
        try:
            self._free()
        except DriverError as error:
            raise SkillError(str(error)) from error
        starter = self._starter
        if starter is None:
            raise SkillError(f"'{self._device}' is not connected")
        starter.suspend()
        self._own = True
        try:
            self._behaviours.stop_program()  # the agent's, which holds
            self._behaviours.load(path)
            failure = self._behaviours.wait_for_program(context, lambda: self._halted)
        finally:
            starter.resume()
            self._wait_for_program()
            self._own = False
        if failure:
            raise SkillError(failure)

    def _wait_for_program(self) -> None:
        """Wait until the agent's program runs again, and ``send`` has returned the position where it holds."""
        end_s = time.monotonic() + _RESTART_S
        sends: int | None = None
        while not self._halted and time.monotonic() < end_s and (sends is None or self._sends < sends + 2):
            newest = self._newest()
            if newest is None or modes.fault(newest.safety_mode, newest.robot_mode) is not None:
                return  # the agent connects, or follows the measured position
            if sends is None and newest.runs(self._session):
                sends = self._sends
            time.sleep(_POLL_S)

    def halt(self) -> None:
        """End the program, which brakes. Its watchdog does the same if the connection is lost."""
        self._halted = True
        connection = self._connection
        if connection is not None:
            connection.end()

    def close(self) -> None:
        """End the program and the connection."""
        starter, self._starter = self._starter, None
        if starter is not None:
            starter.close()
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(UnreachableError):
                connection.end()
            connection.close()

    def _fault(self, newest: Measurement) -> DriverFault | None:
        fault = modes.fault(newest.safety_mode, newest.robot_mode)
        if fault is not None or self._halted or self._own or newest.runs(self._session):
            return fault
        if newest.session == self._session and newest.runtime_state == modes.PAUSED:
            return DriverFault("program-paused", "the program was paused at the robot; continue it there")
        return DriverFault(
            "program-ended", "the program was ended at the robot; select remote control, then restart the agent"
        )

    def _newest(self) -> Measurement | None:
        """The newest measurement, if the connection is alive."""
        try:
            return self._connected().measurement
        except UnreachableError:
            return None

    def _connected(self) -> Connection:
        if self._connection is None:
            raise UnreachableError(f"'{self._device}' is not connected")
        return self._connection

    def _free(self) -> Connection:
        """The connection, if the arm may move.

        Raises:
            DriverError: It is halted, lost, or has stopped itself.
        """
        connection = self._connected()
        if self._halted:
            raise DriverError("the arm was halted; it reconnects")
        fault = self._fault(connection.measurement)
        if fault is not None:
            raise DriverError(f"the arm has stopped itself: {fault.message}")
        return connection

    def _ordered(self, values: Sequence[float]) -> tuple[float, ...]:
        """Values in the robot type's order of the joints."""
        return tuple(values[index] for index in self._from_controller)
