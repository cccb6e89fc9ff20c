"""One connection to NAOqi through the bridge process, with JSON messages, one a line."""

import contextlib
import itertools
import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from device_agent.middleware.bridge_process import BridgeProcess
from device_agent.ports.driver import UnreachableError
from device_agent.ports.skills import SkillError
from device_agent.ports.threads import SupervisedThread

_START_S = 8.0
"""Time until the first measurement [s]; it includes the start of the bridge's Python."""
_OLD_S = 1.0
_END_S = 2.0
_BRIDGE = Path(__file__).with_name("bridge.py")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Settings:
    """How to reach the robot.

    Attributes:
        url: Address of NAOqi: ``tcp://nao.local:9559``.
        python: Interpreter that has the package ``qi``.
        joints: NAOqi's names of the joints, in the order of all values.
        velocity_rad_s: Highest velocity of each joint [rad/s].
        legs: Those joints that NAOqi moves when the robot walks.
    """

    url: str
    python: str
    joints: tuple[str, ...]
    velocity_rad_s: tuple[float, ...]
    legs: tuple[str, ...]


class Measurement(msgspec.Struct, frozen=True, tag="measurement"):
    """Measured joints. ``at_s``: on the monotonic clock of this machine; ``time_ms``: on the robot's clock."""

    at_s: float
    time_ms: float
    position_rad: tuple[float, ...]


class Status(msgspec.Struct, frozen=True, tag="status"):
    """Values that change slowly. ``stiffness`` and ``temperature_c`` are in the order of the joints.

    Attributes:
        guarded: Whether a watchdog on the robot stops it when the network fails.
    """

    at_s: float
    stiffness: tuple[float, ...]
    temperature_c: tuple[float, ...]
    fallen: bool
    fall_manager: bool
    posture: str
    walks: bool
    pose: tuple[float, float, float]
    twist: tuple[float, float, float]
    battery_percent: float
    guarded: bool


class TaskEnd(msgspec.Struct, frozen=True, tag="task"):
    """A task has ended, with an error or with an empty text.

    ``held_rad``: after a behaviour, the angles at which the robot holds; empty if they are unknown.
    """

    task: int
    error: str
    held_rad: tuple[float, ...] = ()


class Behaviours(msgspec.Struct, frozen=True, tag="behaviours"):
    """Names of the behaviours that are installed on the robot. Sent once, before the first measurement."""

    names: tuple[str, ...]


class Failure(msgspec.Struct, frozen=True, tag="failure"):
    """The bridge ends."""

    message: str


class Connection:
    """One bridge process; a lost one is replaced by a new object, so that no value outlives it.

    Args:
        settings: How to reach the robot.
        device: Id of the device at its agent.
        unfinished: Behaviour that a previous bridge may not have ended; empty for a script, ``None`` for none.

    Attributes:
        status: The newest status.
        behaviours: Names of the installed behaviours.
        velocity_rad_s: From the last two measurements.

    Raises:
        UnreachableError: The bridge cannot be started, or the robot sends no valid values in time.
    """

    def __init__(self, settings: Settings, device: str, *, unfinished: str | None = None) -> None:
        self._where = settings.url
        self._count = len(settings.joints)
        self._decoder = msgspec.json.Decoder(_Message)
        self._ready = threading.Event()
        self._closed = threading.Event()
        self._failure = "the NAOqi bridge has ended"
        self._newest: Measurement | None = None
        self._numbers = itertools.count()
        self._tasks: dict[int, TaskEnd | None] = {}
        self._task_changed = threading.Condition()
        self.status: Status | None = None
        self.behaviours: tuple[str, ...] = ()
        self.velocity_rad_s = (0.0,) * self._count
        self._bridge = BridgeProcess("NAOqi bridge", settings.python, _BRIDGE)
        self._thread = SupervisedThread(
            self._receive, name=f"{device}-receiver", part="receiver of the driver", device=device
        )
        self._thread.start()
        self.send(
            url=settings.url,
            joints=settings.joints,
            velocity_rad_s=settings.velocity_rad_s,
            legs=settings.legs,
            unfinished=unfinished,
        )
        if not self._ready.wait(_START_S):
            self.close()
            raise UnreachableError(f"{self._where} sends no valid new values; restart NAOqi")
        if self._closed.is_set():
            self.close()
            raise UnreachableError(
                f"{self._failure}; check the robot's power and address, and the package qi of {settings.python}"
            )

    @property
    def measurement(self) -> Measurement:
        """The newest valid measurement.

        Raises:
            UnreachableError: The connection has ended, or the values are old.
        """
        newest, status = self._newest, self.status
        if self._closed.is_set() or newest is None or status is None:
            raise UnreachableError(f"the connection to {self._where} is lost: {self._failure}")
        if time.monotonic() - min(newest.at_s, status.at_s) > _OLD_S:
            raise UnreachableError(f"{self._where} sends no valid new values")
        return newest

    def send(self, **command: Any) -> None:
        """Send one command: ``angles``, ``twist``, ``hold``, or a task. Never blocks.

        Raises:
            UnreachableError: The bridge has ended or hangs.
        """
        try:
            self._bridge.send(msgspec.json.encode(command))
        except ConnectionError as error:
            self._closed.set()
            raise UnreachableError(str(error)) from error

    def start_task(self, **task: Any) -> int:
        """Start a task that takes time; returns its number for ``wait_for``.

        Raises:
            UnreachableError: As for ``send``.
        """
        number = next(self._numbers)
        with self._task_changed:
            self._tasks[number] = None
        self.send(task=number, **task)
        return number

    def wait_for(self, task: int, timeout_s: float) -> TaskEnd | None:
        """How a task has ended, or ``None`` if it has not within ``timeout_s`` [s].

        Raises:
            SkillError: The connection is lost.
        """
        with self._task_changed:
            self._task_changed.wait_for(lambda: self._tasks[task] is not None or self._closed.is_set(), timeout_s)
            end = self._tasks[task]
            if end is not None:
                del self._tasks[task]
        if end is None and self._closed.is_set():
            raise SkillError(f"the connection to {self._where} is lost")
        return end

    def stop_speech(self, task: int) -> None:
        """End a task that speaks, without waiting for its end.

        Raises:
            UnreachableError: As for ``send``.
        """
        with self._task_changed:
            self._tasks.pop(task, None)
        self.send(stop_speech=True)

    def close(self) -> None:
        """End the bridge, which stops the robot. May be called repeatedly."""
        self._closed.set()
        self._bridge.disconnect()
        self._thread.join(_END_S)
        self._bridge.close()

    def _receive(self) -> None:
        with contextlib.suppress(ConnectionError):
            while not self._closed.is_set():
                for line in self._bridge.receive():
                    with contextlib.suppress(msgspec.DecodeError):
                        self._accept(self._decoder.decode(line))
        self._closed.set()
        self._ready.set()
        with self._task_changed:
            self._task_changed.notify_all()

    def _accept(self, message: "_Message") -> None:
        match message:
            case Measurement():
                self._accept_measurement(message)
            case Status():
                if {len(message.stiffness), len(message.temperature_c)} == {self._count}:
                    self.status = message
            case Behaviours(names=names):
                self.behaviours = names
            case TaskEnd(task=task):
                with self._task_changed:
                    if task in self._tasks:
                        self._tasks[task] = message
                        self._task_changed.notify_all()
            case Failure(message=text):
                self._failure = text
                _log.warning("%s: %s", self._where, text)

    def _accept_measurement(self, message: Measurement) -> None:
        """Keep a measurement if its time of the robot is newer than the previous one. The first one may be old."""
        previous = self._newest
        if len(message.position_rad) != self._count or (previous and message.time_ms <= previous.time_ms):
            return
        if previous:
            elapsed_s = (message.time_ms - previous.time_ms) / 1000
            self.velocity_rad_s = tuple(
                (new - old) / elapsed_s for new, old in zip(message.position_rad, previous.position_rad, strict=True)
            )
        self._newest = message
        if previous and self.status:
            self._ready.set()


_Message = Measurement | Status | TaskEnd | Behaviours | Failure
