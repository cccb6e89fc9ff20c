"""One connection to a robot of LeRobot through the bridge process, with JSON messages, one a line."""

import collections
import contextlib
import logging
import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from device_agent.drivers.lerobot.robots import ROBOTS
from device_agent.drivers.lerobot.units import JointUnit, positions_rad
from device_agent.middleware.bridge_process import BridgeProcess
from device_agent.ports.driver import Twist, UnreachableError
from device_agent.ports.threads import SupervisedThread

_START_S = 9.0
"""Time until the first measurement [s]; it includes the start of the bridge's Python."""
_OLD_S = 1.0
_END_S = 2.0
_SPAN = 6
"""Measurements over which the velocity is averaged, about 0.1 s: one tick of the encoder is 0.08 rad/s in 20 ms."""
_BRIDGE = Path(__file__).with_name("bridge.py")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Settings:
    """How to reach the robot.

    Attributes:
        robot: LeRobot's name of the robot.
        port: Serial port of the servos.
        id: Name of the calibration.
        calibration: Folder of the calibration file, or an empty text: LeRobot's.
        python: Interpreter that has the package ``lerobot``.
        joints: LeRobot's names of the joints, in the order of all values.
        velocity_rad_s: Highest velocity of each joint [rad/s].
        closed_rad: Lower limit of each joint; a closed gripper is there [rad].
        base: Whether the robot has a base.
    """

    robot: str
    port: str
    id: str
    calibration: str
    python: str
    joints: tuple[str, ...]
    velocity_rad_s: tuple[float, ...]
    closed_rad: tuple[float, ...]
    base: bool


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """The robot holds.

    ``range_ticks`` and ``percent`` are in the order of the joints; ``percent``: a gripper. ``motors`` names all servos.
    """

    range_ticks: tuple[int, ...]
    percent: tuple[bool, ...]
    motors: tuple[str, ...]


class Values(msgspec.Struct, frozen=True, tag="measurement"):
    """Measured joints in LeRobot's units, and velocity of the base [m/s, degrees/s].

    ``at_s``: on the monotonic clock of this machine.
    """

    at_s: float
    values: tuple[float, ...]
    twist: tuple[float, float, float]


class Status(msgspec.Struct, frozen=True, tag="status"):
    """Registers of the servos, in the order of ``motors``. ``lost``: share of failed periods of the last 100."""

    at_s: float
    errors: tuple[int, ...]
    torque: tuple[int, ...]
    temperature: tuple[int, ...]
    voltage: tuple[int, ...]
    lost: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """Joints and velocity of the base, in SI units; ``at_s`` on the monotonic clock of this machine."""

    at_s: float
    position_rad: tuple[float, ...]
    twist: Twist


class Failure(msgspec.Struct, frozen=True, tag="failure"):
    """The bridge ends."""

    message: str


class Connection:
    """One bridge process; a lost one is replaced by a new object, so that no value outlives it.

    Args:
        settings: How to reach the robot.
        device: Id of the device at its agent.

    Attributes:
        robot: Class of the robot.
        motors: LeRobot's names of all servos.
        units: Units of the joints.
        status: The newest status.

    Raises:
        UnreachableError: The bridge cannot be started, or the robot sends no valid values in time.
    """

    def __init__(self, settings: Settings, device: str) -> None:
        self._where = f"{settings.robot} at {settings.port}"
        self._closed_rad = settings.closed_rad
        self.robot = ROBOTS[settings.robot]
        self.motors: tuple[str, ...] = ()
        self.units: tuple[JointUnit, ...] = ()
        self._decoder = msgspec.json.Decoder(Ready | Values | Status | Failure)
        self._started = threading.Event()
        self._closed = threading.Event()
        self._failure = "the LeRobot bridge has ended"
        self._measured: collections.deque[Measurement] = collections.deque(maxlen=_SPAN)
        self.status: Status | None = None
        self._bridge = BridgeProcess("LeRobot bridge", settings.python, _BRIDGE)
        self._thread = SupervisedThread(
            self._receive, name=f"{device}-lerobot", part="connection to LeRobot", stopping=self._closed, device=device
        )
        self._thread.start()
        self._configure(settings)
        self._started.wait(_START_S)
        if not self._measured or self.status is None:
            self.close()
            raise UnreachableError(f"{self._where}: {self._failure}")

    @property
    def measurement(self) -> Measurement:
        """The newest valid measurement.

        Raises:
            UnreachableError: The connection has ended, or the values are old.
        """
        status = self.status
        if self._closed.is_set() or not self._measured or status is None:
            raise UnreachableError(f"the connection to {self._where} is lost: {self._failure}")
        newest = self._measured[-1]
        if time.monotonic() - min(newest.at_s, status.at_s) > _OLD_S:
            raise UnreachableError(f"{self._where} sends no valid new values; check cables and power")
        return newest

    @property
    def velocity_rad_s(self) -> tuple[float, ...]:
        """Velocities over the last measurements [rad/s]."""
        measured = tuple(self._measured)
        elapsed_s = measured[-1].at_s - measured[0].at_s if measured else 0.0
        if elapsed_s <= 0:
            return (0.0,) * len(self._closed_rad)
        positions = zip(measured[-1].position_rad, measured[0].position_rad, strict=True)
        return tuple((new - old) / elapsed_s for new, old in positions)

    def send(self, **command: Any) -> None:
        """Send one command: ``values`` and ``twist`` in LeRobot's units, or ``hold``. Never blocks.

        Raises:
            UnreachableError: The bridge has ended or hangs.
        """
        try:
            self._bridge.send(msgspec.json.encode(command))
        except ConnectionError as error:
            self._closed.set()
            raise UnreachableError(f"{self._where}: {self._failure}") from error

    def close(self) -> None:
        """End the bridge, which stops the robot. May be called repeatedly."""
        self._closed.set()
        self._bridge.disconnect()
        self._thread.join(_END_S)
        self._bridge.close()

    def _configure(self, settings: Settings) -> None:
        servos = self.robot.servos
        self.send(
            module=self.robot.module,
            name=self.robot.name,
            port=settings.port,
            id=settings.id,
            calibration=settings.calibration,
            joints=settings.joints,
            base=settings.base,
            speeds=[servos.speed(velocity) for velocity in settings.velocity_rad_s],
            registers={
                "errors": servos.error_register,
                "voltage": servos.voltage_register,
                "speed": servos.speed_register,
            },
        )

    def _receive(self) -> None:
        with contextlib.suppress(ConnectionError):
            while not self._closed.is_set():
                for line in self._bridge.receive():
                    with contextlib.suppress(msgspec.DecodeError):
                        self._accept(self._decoder.decode(line))
        self._closed.set()
        self._started.set()

    def _accept(self, message: Ready | Values | Status | Failure) -> None:
        match message:
            case Ready(range_ticks=ranges, percent=percent, motors=motors):
                self.motors = motors
                self.units = tuple(
                    JointUnit(ticks, closed if gripper else None)
                    for ticks, gripper, closed in zip(ranges, percent, self._closed_rad, strict=True)
                )
            case Values(at_s=at_s, values=values, twist=(forward, left, turn)):
                position = positions_rad(self.units, values)
                if position is not None:
                    twist = Twist(forward, left, math.radians(turn))
                    self._measured.append(Measurement(at_s, position, twist))
            case Status():
                self.status = message
                if self._measured:
                    self._started.set()
            case Failure(message=text):
                self._failure = text
                _log.warning("%s: %s", self._where, text)
