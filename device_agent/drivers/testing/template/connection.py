"""TCP connection to the device: JSON messages, one a line, in degrees. Replace this with your device's protocol."""

import json
import logging
import math
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from device_agent.ports.driver import UnreachableError
from device_agent.ports.threads import SupervisedThread

_TIMEOUT_S = 2.0
"""Time to connect, and to the first measurement [s]."""
_CHECK_S = 0.1
_MAX_LINE = 65536
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Measurement:
    """A valid message of the device, in SI units and in the order of the driver's joints."""

    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    safety: str
    device_time_s: float
    at_s: float


class Connection:
    """One connection; a lost one is replaced by a new object, so that no value outlives it.

    Args:
        address: Host and port.
        joints: Names of the joints, in the order of the robot type.
        device: Id of the device at its agent.

    Raises:
        UnreachableError: No connection, or no valid message in time.
    """

    def __init__(self, address: tuple[str, int], joints: Sequence[str], device: str) -> None:
        self._joints = tuple(joints)
        self._where = f"{address[0]}:{address[1]}"
        self._ready = threading.Event()
        self._closed = threading.Event()
        self.newest: Measurement | None = None
        try:
            self._socket = socket.create_connection(address, timeout=_TIMEOUT_S)
        except OSError as error:
            raise UnreachableError(f"no connection to {self._where}: {error}; is the device switched on?") from error
        self._socket.settimeout(_CHECK_S)
        self._thread = SupervisedThread(
            self._receive, name=f"{device}-receiver", part="receiver of the driver", device=device
        )
        self._thread.start()
        if not self._ready.wait(_TIMEOUT_S) or self._closed.is_set():
            self.close()
            raise UnreachableError(f"{self._where} sends no valid new values; check its protocol version")

    @property
    def measurement(self) -> Measurement:
        """The newest valid message.

        Raises:
            UnreachableError: The connection has ended.
        """
        if self._closed.is_set() or self.newest is None:
            raise UnreachableError(f"the connection to {self._where} is lost")
        return self.newest

    def send(self, message: Mapping[str, object]) -> None:
        """Send one message.

        Raises:
            UnreachableError: The connection has ended.
        """
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            self._closed.set()
            raise UnreachableError(f"the connection to {self._where} is lost: {error}") from error

    def close(self) -> None:
        """End the connection and its thread. May be called repeatedly."""
        self._closed.set()
        self._socket.close()
        self._thread.join(_TIMEOUT_S)

    def _receive(self) -> None:
        buffer = b""
        while not self._closed.is_set():
            try:
                received = self._socket.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                break
            if not received or len(buffer) > _MAX_LINE:
                break
            *lines, buffer = (buffer + received).split(b"\n")
            for line in lines:
                self._accept(line)
        self._closed.set()
        self._ready.set()

    def _accept(self, line: bytes) -> None:
        """Keep a message if it is valid and newer than the previous one. The first one may be old."""
        try:
            measurement = self._parse(json.loads(line))
        except (ValueError, KeyError, TypeError) as error:
            _log.debug("%s: message rejected: %r", self._where, error)
            return
        previous = self.newest
        if previous is None or measurement.device_time_s > previous.device_time_s:
            self.newest = measurement
            if previous is not None:
                self._ready.set()

    def _parse(self, message: Mapping[str, list[float]]) -> Measurement:
        """A message in SI units.

        Raises:
            ValueError: A value is not finite, or the number of values is wrong. Also ``KeyError`` and ``TypeError``.
        """
        names = message["names"]

        def values(field: str) -> tuple[float, ...]:
            by_name = dict(zip(names, map(float, message[field]), strict=True))
            return tuple(_finite(by_name[joint]) for joint in self._joints)  # type: ignore[index]

        return Measurement(
            position_rad=tuple(map(math.radians, values("position_deg"))),
            velocity_rad_s=tuple(map(math.radians, values("velocity_deg_s"))),
            effort_nm=values("effort_nm"),
            safety=str(message["safety"]),
            device_time_s=_finite(float(message["time_s"])),  # type: ignore[arg-type]
            at_s=time.monotonic(),
        )


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("a value is not finite")
    return value
