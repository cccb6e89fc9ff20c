"""What a driver does for one device. This page is the implementer's manual."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from device_agent.ports.sensor import Frame
from device_agent.protocol import Pose, Twin


class DriverError(Exception):
    """The hardware or simulation cannot do what was asked. Its text is fit for an operator."""


class Twist(NamedTuple):
    """How a base moves over the floor, seen from itself."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    turn_rad_s: float = 0.0


REST = Twist()
"""Not at all."""


@dataclass(frozen=True, slots=True)
class Observation:
    """All joints of a device at one moment, in the order of the robot type's ``joints``.

    Attributes:
        position_rad: Measured, shape (n,) [rad].
        velocity_rad_s: Measured, shape (n,) [rad/s].
        effort_nm: Torque at the joint, shape (n,) [N m].
        frames: Pose of each of the type's ``frames`` in the robot's base frame.
    """

    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    frames: tuple[Pose, ...]


class Driver(Protocol):
    """Makes one kind of robot do what the agent asks.

    One thread calls it, the device's control loop, once per ``period_ms``: ``observe`` then ``send`` (see also
    ``RunsInline``). Neither blocks longer than a fraction of the period. The constructor touches neither disk, network nor
    hardware.
    """

    @property
    def simulated(self) -> bool:
        """Whether no real metal moves. Known before ``connect``."""

    def connect(self) -> None:
        """Open the hardware or build the simulation; afterwards the device holds still where it is.

        Raises:
            DriverError: It is not there, or does not answer; the text says what to check.
        """

    def twin(self) -> Twin | None:
        """The drawing for live views, or ``None`` where the driver knows none. Called once, after ``connect``."""

    def observe(self) -> Observation:
        """The newest measurement.

        Raises:
            DriverError: The device no longer answers. The agent then holds and raises a fault.
        """

    def send(self, position_rad: Sequence[float]) -> tuple[float, ...]:
        """Command joint positions for the next period, shape (n,) [rad], already limited by the agent.

        Returns:
            What was really applied, after the driver's own clamping, shape (n,) [rad].

        Raises:
            DriverError: As for ``observe``.
        """

    def close(self) -> None:
        """Let go. May be called twice, and without ``connect``."""


@runtime_checkable
class RunsInline(Driver, Protocol):
    """A driver whose ``observe``, ``send`` and ``drive`` only look into memory, as of a simulation beside it.

    They return within microseconds, and different threads may call them, one at a time: a Stop is then carried out by
    the thread that brings it, and while the device rests a setpoint too. Another driver waits for its control loop.
    """

    @property
    def prompt(self) -> bool:
        """Whether that is so."""


@runtime_checkable
class MobileDriver(Driver, Protocol):
    """A driver whose robot drives or walks: its robot type has a ``base``."""

    def drive(self, twist: Twist) -> Twist:
        """Command how the base moves for the next period, already limited by the agent. Called after each ``send``.

        Returns:
            What was really applied, after the driver's own clamping.

        Raises:
            DriverError: As for ``observe``.
        """


@runtime_checkable
class ReportsStreams(Protocol):
    """A driver that measures more than joints: what its robot type's ``streams`` name besides ``joints``."""

    def report(self, stream: str) -> Mapping[str, float | bool]:
        """The newest values of one stream, by quantity with its unit, a dot and the part where there are several.

        Called at the stream's rate, from one thread that is not the control loop and may run beside it; also before
        ``connect`` has succeeded, and while the device does not answer. What is not finite is left out.

        Returns:
            ``{"distance_m.left": 0.81}``; empty where there is nothing to tell just now.

        Raises:
            DriverError: It cannot be measured now; it is asked again when the stream is next due.
        """


@runtime_checkable
class HasCameras(Protocol):
    """A driver whose robot has cameras: what its robot type's ``cameras`` name."""

    def frame(self, camera: str) -> Frame | None:
        """A picture taken now; ``None`` where it has none at this moment.

        Called at the camera's rate while somebody controls the robot, else once a second at most, from one thread that
        is neither the control loop nor that of ``report``, and may run beside both; also before ``connect`` has
        succeeded. A picture is at most 128 KB: small, and JPEG.

        Raises:
            DriverError: No such camera, or it failed; it is asked again when the next picture is due.
        """


@runtime_checkable
class HasSpeaker(Driver, Protocol):
    """A driver whose robot is heard by others when it speaks: of a simulated robot, by what listens in its room."""

    def speaks(self, for_s: float) -> None:
        """It speaks from now on for so long [s]. Never blocks; only for what listens, the words go elsewhere."""
