"""Base class of sensors with ROS: one connection and the newest message of one topic."""

import time
from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np

from device_agent.middleware.ros.connection import Connection, Subscription
from device_agent.middleware.ros.messages import Dialect
from device_agent.ports.driver import UnreachableError
from device_agent.ports.sensor import Capture, Floats, Image, Scan, SensorError, Values
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.frames import check_kinds
from device_agent.sensors.ros.options import Options

_START_S = 3.0
"""Time to the first message [s]."""
_CHECK_S = 0.005
SILENT_S = 1.0
"""A sensor without a message for this time does not respond [s]."""
_PERIOD_MS = 50
"""Shortest time between two messages [ms]."""


class RosSensor:
    """A room device that measures. It has no controls.

    Args:
        device: Its entry in the room's manifest.
        options: Where its measurements are.
    """

    TYPE: ClassVar[str]
    """Type of the topic."""
    MESSAGE: ClassVar[Any]
    """Python type of its messages."""
    STREAMS: ClassVar[Sequence[str]] = ()
    CAPTURES: ClassVar[Sequence[str]] = ()
    FRAMES: ClassVar[Sequence[str]] = ()
    """Kinds of frames for viewers."""

    def __init__(self, device: RoomDeviceManifest, options: Options) -> None:
        check_kinds(device, self.FRAMES)
        self.device = device
        self.options = options
        self._connection: Connection | None = None
        self._newest: tuple[Any, float] | None = None

    # ------------------------------------------------------------ RoomDriver

    @property
    def simulated(self) -> bool:
        """As configured: ROS itself does not tell."""
        return self.options.simulated

    def connect(self) -> None:
        """Connect, and wait for a message."""
        if self._connection is not None and not self._connection.lost:
            return
        self.close()
        dialect, topic = Dialect(self.options.ros), self.options.topic
        try:
            connection = Connection(
                self.options.open(self.device.name),
                subscriptions=[Subscription(topic, dialect.type(self.TYPE), self.MESSAGE, self._accept, _PERIOD_MS)],
                advertised={},
                device=self.device.name,
                clock=time.monotonic,
            )
        except UnreachableError as error:
            raise SensorError(str(error)) from error
        self._connection = connection
        end_s = time.monotonic() + _START_S
        while self._newest is None:
            if connection.lost or time.monotonic() > end_s:
                self.close()
                raise SensorError(f"'{self.device.name}': no message on {topic}{_reason(connection)}")
            time.sleep(_CHECK_S)

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        self.newest()
        return self.reject("stream", stream, self.STREAMS)

    def capture(self, name: str) -> Capture:
        """See ``RoomDriver``."""
        self.newest()
        return self.reject("capture", name, self.CAPTURES)

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        del value
        return self.reject("control", control, ())

    def raw(self) -> Scan | Image | None:
        """See ``RoomDriver``. A message is used until the next one, at most for ``SILENT_S``."""
        return None

    def close(self) -> None:
        """See ``RoomDriver``."""
        connection, self._connection, self._newest = self._connection, None, None
        if connection is not None:
            connection.close()

    # ------------------------------------------------------------ for subclasses

    def check(self, message: Any) -> None:
        """Check a message when it arrives.

        Raises:
            ValueError: It is invalid, and is not used.
        """

    def newest(self) -> tuple[Any, float]:
        """The newest message and its arrival [s].

        Raises:
            SensorError: There is none, or it is too old.
        """
        connection, newest = self._connection, self._newest
        if connection is None or newest is None:
            raise SensorError(f"'{self.device.name}' is not connected")
        if connection.lost:
            raise SensorError(f"the connection to {connection.where} is lost{_reason(connection)}")
        if time.monotonic() - newest[1] > SILENT_S:
            raise SensorError(
                f"'{self.device.name}': no new message on {self.options.topic}{_reason(connection)}; is it running?"
            )
        return newest

    def pose(self) -> tuple[Floats, Floats]:
        """Position in the room [m], and axes of the sensor in the room as columns."""
        (a, b, c), (p, q, r) = np.cos(self.options.rotation_rad), np.sin(self.options.rotation_rad)
        about_x = np.array([[1, 0, 0], [0, a, -p], [0, p, a]])
        about_y = np.array([[b, 0, q], [0, 1, 0], [-q, 0, b]])
        about_z = np.array([[c, -r, 0], [r, c, 0], [0, 0, 1]])
        return np.array(self.device.position_m, np.float64), np.asarray(about_z @ about_y @ about_x, np.float64)

    def reject(self, label: str, name: str, known: Sequence[str]) -> NoReturn:
        """Raise the error for an unknown name."""
        available = ", ".join(known) or "none"
        raise SensorError(f"'{self.device.name}' has no {label} '{name[:80]}'; it has: {available}")

    def _accept(self, message: Any, at_s: float) -> None:
        self.check(message)
        self._newest = message, at_s


def _reason(connection: Connection) -> str:
    return f" ({connection.problem})" if connection.problem else ""
