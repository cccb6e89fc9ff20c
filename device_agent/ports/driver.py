"""Port: driver of one device. The implementer's manual."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from device_agent.ports.sensor import Frame
from device_agent.protocol import Pose, Twin


class DriverError(Exception):
    """The hardware or simulation cannot execute the request. The message is shown to operators."""


class UnreachableError(DriverError):
    """The device cannot be used now, but may be later: it is off, not connected, or sends no valid measurements.

    The agent starts without the device, reports a fault, and connects again every second.
    """


class Twist(NamedTuple):
    """Velocity of a base in its own frame."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0


REST = Twist()
"""No motion."""


@dataclass(frozen=True, slots=True)
class Observation:
    """All joints of a device at one moment, in the order of the robot type's ``joints``.

    Attributes:
        position_rad: Measured positions, shape (n,) [rad].
        velocity_rad_s: Measured velocities, shape (n,) [rad/s].
        effort_nm: Joint torques, shape (n,) [N m].
        frames: Pose of each of the type's ``frames`` in the robot's base frame.
        at_s: When the device sent new values last, on the agent's monotonic clock [s]; ``None``: just now. A message
            that repeats the device's previous timestamp is not new.
        settled: False while the device's own controller has not reported the end of the last command. A motion is not
            done before. Devices without such reports are always settled.
    """

    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    frames: tuple[Pose, ...]
    at_s: float | None = None
    settled: bool = True


class Driver(Protocol):
    """Executes the agent's requests on one kind of robot.

    One thread, the control loop, calls ``observe`` and ``send`` once per ``period_ms`` (see also ``RunsInline``).
    Neither blocks for longer than a fraction of the period. The constructor accesses neither disk, network nor
    hardware. Threads of a driver are ``SupervisedThread``; ``close`` ends them.

    A device may be lost and return at any time. Then ``observe``, ``send`` and ``drive`` raise ``UnreachableError``.
    The control loop calls ``connect`` every second until it succeeds, and takes the measured positions as the present
    ones. A driver never connects again on its own, and never repeats a command after a reconnection.

    The device must not depend on the agent to come to rest: without new commands it holds its joints, and a base that
    would continue to move brakes (see ``MobileDriver``). A driver that commands velocities of joints needs a watchdog
    for them too: ``device_agent.drivers.watchdog``.
    """

    @property
    def simulated(self) -> bool:
        """Whether the device is simulated. Known before ``connect``."""

    def connect(self) -> None:
        """Open the hardware or build the simulation; afterwards the device holds its position.

        It also replaces a lost connection, within 10 s. It returns after a complete measurement that is known to be
        new: if the device sends timestamps, after the second one.

        Raises:
            UnreachableError: The device is missing or does not respond; the message names what to check.
            DriverError: The device can never be used as configured; at its start the agent ends with this message.
        """

    def twin(self) -> Twin | None:
        """Model for live views, or ``None``. Called once, after ``connect``, also if the device is unreachable."""

    def observe(self) -> Observation:
        """The newest measurement: finite values of all joints, matched by name and converted to SI units.

        Raises:
            UnreachableError: The device has sent no valid new values for some time, at most 1 s. The agent then holds
                and raises a fault.
        """

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command joint positions for the next period, shape (n,) [rad], limited by the agent.

        Returns:
            The positions that were applied, after limits of the driver and the device, shape (n,) [rad].

        Raises:
            DriverError: As for ``observe``; or wrong number of values, a value is not finite, or the device has stopped
                itself. Nothing is sent to the device then.
        """

    def halt(self) -> None:
        """Stop all motion at once and hold, by the driver's own means, because the control loop has ended or hangs.

        Any thread may call it at any time, repeatedly, also without ``connect``. It neither blocks nor waits for a lock
        that another call may hold. Until the next ``connect``, ``send`` and ``drive`` raise ``DriverError``, so that a
        delayed command does not move the device again.

        Raises:
            DriverError: The device cannot be reached.
        """

    def close(self) -> None:
        """Release the device. May be called repeatedly, and without ``connect``."""


@runtime_checkable
class RunsInline(Driver, Protocol):
    """A driver whose ``observe``, ``send`` and ``drive`` only access memory, such as a simulation in the same process.

    They return within microseconds, and different threads may call them one at a time. The thread that receives a Stop
    then applies it immediately, and applies setpoints while the device rests. Other drivers wait for the control loop.
    """

    @property
    def prompt(self) -> bool:
        """Whether this applies to the instance."""


@dataclass(frozen=True, slots=True)
class DriverFault:
    """A fault that the device reports itself, for example a safety mode.

    Attributes:
        code: Kind of the fault: ``protective-stop``. Operators see it as ``driver.protective-stop``.
        message: What has happened, and what to do.
        stops: Whether the device has stopped itself, or must not move. The agent then sends no commands, latches Stop,
            and holds at the measured position. After the fault an operator resets Stop. Other faults are only shown.
    """

    code: str
    message: str
    stops: bool = True


@runtime_checkable
class ReportsFaults(Driver, Protocol):
    """A driver of a device with safety modes, protective stops or other faults of its own."""

    def faults(self) -> Sequence[DriverFault]:
        """The present faults; empty if there are none or they are unknown.

        The control loop calls it after each ``observe``. It only accesses memory. An unknown safety mode is a fault
        that ``stops``.
        """


@runtime_checkable
class MobileDriver(Driver, Protocol):
    """A driver of a mobile robot; its robot type has a ``base``.

    A watchdog in the hardware or the driver brakes the base to rest if ``drive`` was not called for 0.3 s. It works
    while the agent's threads hang, and should work after the agent's process has ended.
    """

    def drive(self, twist: Twist) -> Twist:
        """Command the velocity of the base for the next period, limited by the agent. Called after each ``send``.

        Returns:
            The velocity that was applied, after limits of the driver.

        Raises:
            DriverError: As for ``observe``.
        """


@runtime_checkable
class ReportsStreams(Protocol):
    """A driver that measures the robot type's ``streams`` other than ``joints``."""

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """The newest values of one stream, by quantity with unit, and a dot and the part if there are several.

        Called at the stream's rate from one thread, concurrently with the control loop, also before ``connect``
        succeeds and while the device does not respond. Values that are not finite are omitted.

        Returns:
            ``{"distance_m.left": 0.81}``; empty if there is no measurement now.

        Raises:
            DriverError: The stream cannot be measured now; the agent tries again when it is due.
        """


@runtime_checkable
class HasCameras(Protocol):
    """A driver with the cameras of its robot type."""

    def frame(self, camera: str) -> Frame | None:
        """A frame taken now, or ``None`` if there is none.

        Called at the camera's rate while an operator has control, else at most once per second. The calling thread is
        neither the control loop nor that of ``report``. It runs concurrently, also before ``connect`` succeeds. A
        frame is a JPEG of at most 128 KB.

        Raises:
            DriverError: The camera is unknown or failed; the agent tries again when the next frame is due.
        """


@runtime_checkable
class HasSpeaker(Driver, Protocol):
    """A driver whose robot is audible to the simulated microphones of its room."""

    def start_speech(self, for_s: float) -> None:
        """Emit speech sound from now on for ``for_s`` [s]. Never blocks; the text is published separately."""
