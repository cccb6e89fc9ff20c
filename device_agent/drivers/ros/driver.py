"""Driver of a robot with ROS. ``device_agent/ports/driver.py`` documents each method."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from device_agent.drivers.command_limits import limit_positions
from device_agent.drivers.ros.goals import Goals
from device_agent.drivers.ros.joint_commands import JointCommands
from device_agent.drivers.ros.joint_states import JointStates, Measurement
from device_agent.drivers.ros.options import Options, RawCamera
from device_agent.drivers.ros.pictures import Pictures
from device_agent.drivers.ros.robot_status import RobotStatus
from device_agent.middleware.ros import messages
from device_agent.middleware.ros.connection import Command, Connection, Subscription
from device_agent.middleware.ros.images import RawImage
from device_agent.middleware.ros.messages import Dialect
from device_agent.middleware.ros.scans import LaserScan
from device_agent.ports.driver import DriverError, DriverFault, Observation, UnreachableError
from device_agent.ports.sensor import Frame
from device_agent.protocol import Twin
from device_agent.protocol.description import Stream
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.simulation.mjcf.robot_model import RobotModel

_START_S = 3.0
"""Time to the second message with all joints [s]."""
_CHECK_S = 0.005
_STALE_S = 1.0
_RECENT_S = 0.2
"""A position that is older is not held [s]."""


class RosDriver:
    """Drives the joints of one robot.

    Args:
        robot_type: Joints, limits and frames.
        folder: Folder of the robot type, for its model.
        options: Which topics carry what.
        device: Id of the device at its agent.
    """

    def __init__(self, robot_type: RobotType, folder: Path, options: Options, device: str) -> None:
        self._type = robot_type
        self._model = RobotModel(robot_type, folder)
        self._options = options
        self._device = device
        self._names = [options.names.get(joint.name, joint.name) for joint in robot_type.joints]
        self._dialect = Dialect(options.ros)
        self._commands = self._new_commands()
        self._states = self._new_states()
        self._status = RobotStatus(options)
        self._pictures = Pictures(options.cameras)
        self._connection: Connection | None = None
        self._halted = False

    @property
    def simulated(self) -> bool:
        """As configured: ROS itself does not tell."""
        return self._options.simulated

    def connect(self) -> None:
        """Connect, wait for a second measurement of every joint, and let the arm hold its position."""
        self.close()
        self._states, self._status = self._new_states(), RobotStatus(self._options)
        self._commands = self._new_commands()
        connection = Connection(
            self._options.open(self._device),
            subscriptions=self._subscriptions(self._states, self._status),
            advertised=self._advertised(),
            device=self._device,
            clock=time.monotonic,
            results={goals.action: goals.accept_ros2 for goals in self._goals},
        )
        try:
            measured = self._wait(connection)
            self._hold(connection, measured)
        except UnreachableError:
            connection.close()
            raise
        self._connection, self._halted = connection, False

    def twin(self) -> Twin | None:
        """The model of the robot type; it needs no connection."""
        return self._model.twin(self._device)

    def observe(self) -> Observation:
        """The newest measurement."""
        connection, now_s = self._connected(), time.monotonic()
        newest = self._measured(connection)
        for goals in self._goals:
            cancellation = goals.cancel_overdue(now_s)
            if cancellation is not None:
                connection.publish(cancellation)
        return Observation(
            newest.position_rad,
            newest.velocity_rad_s,
            newest.effort_nm,
            self._model.frames(newest.position_rad),
            at_s=newest.at_s,
            settled=not any(goals.pending for goals in self._goals),
        )

    def faults(self) -> tuple[DriverFault, ...]:
        """Safety topics, diagnostics and goals that have failed."""
        connection = self._connection
        return () if connection is None or connection.lost else self._faults()

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command positions within the limits of the joints."""
        connection = self._free()
        applied = limit_positions(self._type, position_rad)
        measured, now_s = self._measured(connection), time.monotonic()
        for commands in self._commands:
            self._command(connection, commands.towards(applied, measured, now_s))
        return applied

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """``health``: battery; ``odometry``: pose and velocity of the base; others: ranges of a scan."""
        connection = self._connection
        return {} if connection is None or connection.lost else self._status.report(stream)

    def frame(self, camera: str) -> Frame | None:
        """The newest picture of a camera."""
        return self._pictures.take(camera)

    def halt(self) -> None:
        """Brake, and hold."""
        self._halted = True
        connection = self._connection
        if connection is not None:
            self._hold(connection, self._states.newest)

    def close(self) -> None:
        """End the connection. A motion ends with its short trajectory."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    # ------------------------------------------------------------ topics

    def _subscriptions(self, states: JointStates, status: RobotStatus) -> list[Subscription]:
        options, subscriptions = self._options, []

        def add(topic: str, kind: str, message: Any, accept: Any) -> None:
            if topic:
                subscriptions.append(Subscription(topic, self._dialect.type(kind), message, accept))

        add(options.joint_states, "sensor_msgs/JointState", messages.JointState, states.accept)
        add(options.battery, "sensor_msgs/BatteryState", messages.BatteryState, status.accept_battery)
        add(options.diagnostics, "diagnostic_msgs/DiagnosticArray", messages.DiagnosticArray, status.accept_diagnostics)
        for stream, topic in options.scans.items():
            add(topic, "sensor_msgs/LaserScan", LaserScan, partial(status.accept_scan, stream))
        subscriptions += [self._camera(camera) for camera in self._type.cameras if camera.name in options.cameras]
        for safety in options.safety:
            add(safety.topic, safety.type, dict[str, Any], partial(status.accept_safety, safety))
        if options.base is not None:
            add(options.base.odometry, "nav_msgs/Odometry", messages.Odometry, status.accept_odometry)
            if options.base.fixed_frame:
                add("/tf", "tf2_msgs/TFMessage", messages.Transforms, status.transforms.accept)
                static = partial(status.transforms.accept, static=True)
                add("/tf_static", "tf2_msgs/TFMessage", messages.Transforms, static)
        return [*subscriptions, *(each for goals in self._goals for each in goals.subscriptions)]

    def _camera(self, camera: Stream) -> Subscription:
        source, period_ms = self._options.cameras[camera.name], round(1000 / camera.rate_hz)
        if isinstance(source, RawCamera):
            kind, accept_raw = self._dialect.type("sensor_msgs/Image"), partial(self._pictures.accept_raw, camera.name)
            return Subscription(source.raw, kind, RawImage, accept_raw, period_ms)
        kind, accept = self._dialect.type("sensor_msgs/CompressedImage"), partial(self._pictures.accept, camera.name)
        return Subscription(source, kind, messages.CompressedImage, accept, period_ms)

    def _advertised(self) -> dict[str, str]:
        return {topic: kind for commands in self._commands for topic, kind in commands.advertised.items()}

    # ------------------------------------------------------------ measurements

    def _new_states(self) -> JointStates:
        return JointStates(self._names, check_delay=not self._options.simulated)

    def _new_commands(self) -> tuple[JointCommands, ...]:
        controllers = self._options.controllers
        return tuple(JointCommands(self._type, self._names, each, self._dialect) for each in controllers)

    @property
    def _goals(self) -> list[Goals]:
        return [commands.goals for commands in self._commands if commands.goals is not None]

    @property
    def _missing_server(self) -> str:
        """An action whose server has published nothing; empty if there is none."""
        return next((goals.action for goals in self._goals if not goals.present), "")

    def _faults(self) -> tuple[DriverFault, ...]:
        now_s = time.monotonic()
        problems = [problem for goals in self._goals if (problem := goals.problem(now_s))]
        return (*self._status.faults(), *(DriverFault("goal", problem) for problem in problems))

    def _wait(self, connection: Connection) -> Measurement:
        """Wait for the first measurement that is known to be new, all safety topics and all action servers.

        Raises:
            UnreachableError: They do not arrive in time.
        """
        end_s = time.monotonic() + _START_S
        while not connection.lost and time.monotonic() < end_s:
            newest = self._states.newest
            if newest is not None and not self._status.silent_safety_topic and not self._missing_server:
                return newest
            time.sleep(_CHECK_S)
        raise self._unreachable(connection, time.monotonic() - _STALE_S)

    def _measured(self, connection: Connection) -> Measurement:
        """The newest measurement.

        Raises:
            UnreachableError: There is none, or it is too old.
        """
        newest, oldest_s = self._states.newest, time.monotonic() - _STALE_S
        if connection.lost or newest is None or newest.at_s < oldest_s:
            raise self._unreachable(connection, oldest_s)
        return newest

    def _unreachable(self, connection: Connection, oldest_s: float) -> UnreachableError:
        """The reason why there is no measurement, for operators."""
        reason = f" ({connection.problem})" if connection.problem else ""
        if connection.lost:
            return UnreachableError(f"the connection to {connection.where} is lost{reason}")
        missing = self._states.missing(oldest_s)
        if missing:
            topic = self._options.joint_states
            return UnreachableError(f"{topic} has no new values of the joints {', '.join(missing)}{reason}")
        if self._missing_server:
            return UnreachableError(f"no action server at {self._missing_server}; start its controller{reason}")
        return UnreachableError(f"no message of the safety topic {self._status.silent_safety_topic}{reason}")

    # ------------------------------------------------------------ commands

    def _connected(self) -> Connection:
        if self._connection is None:
            raise UnreachableError(f"'{self._device}' is not connected")
        return self._connection

    def _free(self) -> Connection:
        """The connection, if the robot may move.

        Raises:
            DriverError: It is halted, lost, or has stopped itself.
        """
        connection = self._connected()
        if self._halted:
            raise DriverError("the robot was halted; it reconnects")
        if connection.lost:
            raise self._unreachable(connection, time.monotonic())
        for fault in self._faults():
            if fault.stops:
                raise DriverError(f"the robot has stopped itself: {fault.message}")
        return connection

    def _command(self, connection: Connection, command: Command | None) -> None:
        """Publish a command. If the robot was halted meanwhile, halt it again: this command may have come later.

        Raises:
            DriverError: The connection is lost, or the robot was halted.
        """
        if command is not None:
            connection.publish(command)
        if self._halted:
            self.halt()
            raise DriverError("the robot was halted; it reconnects")

    def _hold(self, connection: Connection, measured: Measurement | None) -> None:
        """Brake. An old position would be a motion back to it; then goals are cancelled, and other commands end."""
        recent = measured is not None and time.monotonic() - measured.at_s < _RECENT_S
        for commands in self._commands:
            if recent and measured is not None:
                connection.publish(commands.hold(measured))
            elif commands.goals is not None and (cancellation := commands.goals.cancel()) is not None:
                connection.publish(cancellation)
