"""RTDE connection to one controller: measurements, setpoints and the end of a session."""

import logging
import math
import select
import socket
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from device_agent.drivers.ur import modes, program, rtde
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.ports.threads import SupervisedThread

JOINTS = 6
_OUTPUTS = (
    ("timestamp", "DOUBLE"),
    ("actual_q", "VECTOR6D"),
    ("actual_qd", "VECTOR6D"),
    ("target_moment", "VECTOR6D"),
    ("joint_temperatures", "VECTOR6D"),
    (f"output_int_register_{program.RUNNING}", "INT32"),
    (f"output_int_register_{program.BEAT}", "INT32"),
    ("robot_mode", "INT32"),
    ("safety_mode", "INT32"),
    ("runtime_state", "UINT32"),
)
_IO = (
    ("actual_digital_input_bits", "UINT64"),
    ("actual_digital_output_bits", "UINT64"),
    ("tool_analog_input0", "DOUBLE"),
    ("tool_analog_input1", "DOUBLE"),
    ("tool_output_voltage", "INT32"),
)
"""Measured only if the configuration or the robot type needs them."""
_SETPOINT = (
    (f"input_int_register_{program.SESSION}", "INT32"),
    (f"input_int_register_{program.COUNTER}", "INT32"),
    *((f"input_double_register_{program.TARGET + index}", "DOUBLE") for index in range(JOINTS)),
)
_END = ((f"input_int_register_{program.END}", "INT32"),)
_CANCELLED = ((f"input_int_register_{program.CANCELLED}", "INT32"),)
"""Recipes of their own, so that a setpoint sent by another thread cannot overwrite them."""

_TIMEOUT_S = 2.0
"""Time to connect, for all responses, and to the second measurement [s]."""
_CHECK_S = 0.1
_STALE_S = 1.0
"""The connection counts as lost without a new measurement for this time [s]."""
_BEAT_S = 0.5
"""The program counts as ended without a new cycle for this time [s]; a stop takes less."""
_MAX_MODE = 100
_MAX_RUNTIME_STATE = 5
_MAX_POSITION_RAD = 4 * math.pi
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Measurement:
    """A valid data package, in the controller's order of the joints.

    Attributes:
        time_s: The controller's time [s].
        session: Session of the program that has started last.
        beat: Cycle of the program.
        beat_s: When the beat changed last, in the controller's time [s].
        protective_s: When the present protective stop began or was first seen, in the controller's time [s].
        at_s: When the package arrived [s].
        inputs: Digital inputs as bits: standard from 0, configurable from 8, tool from 16.
        outputs: Digital outputs, as ``inputs``.
        tool_analog: Analog inputs of the tool [V, or A as configured].
        tool_voltage_v: Voltage of the tool's supply [V].
    """

    time_s: float
    position_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    effort_nm: tuple[float, ...]
    temperature_c: tuple[float, ...]
    session: int
    beat: int
    robot_mode: int
    safety_mode: int
    runtime_state: int
    beat_s: float
    protective_s: float
    at_s: float
    inputs: int = 0
    outputs: int = 0
    tool_analog: tuple[float, float] = (0.0, 0.0)
    tool_voltage_v: int = 0

    def runs(self, session: int) -> bool:
        """Whether the program of this session runs."""
        alive = self.time_s - self.beat_s < _BEAT_S
        return self.session == session and self.runtime_state == modes.PLAYING and alive


class Connection:
    """One connection; a lost one is replaced by a new object, so that no value outlives it.

    Args:
        address: Host and RTDE port.
        session: Number of the session.
        frequency_hz: Rate of measurements [Hz].
        device: Id of the device at its agent.
        io: Measure inputs and outputs.
        banks: Kinds of outputs that are set: ``standard``, ``tool``.

    Raises:
        UnreachableError: No connection, no valid measurement in time, or another client writes the same registers.
        DriverError: The controller's software is too old.
    """

    def __init__(
        self,
        address: tuple[str, int],
        *,
        session: int,
        frequency_hz: float,
        device: str,
        io: bool = False,
        banks: Collection[str] = (),
    ) -> None:
        self._where = f"{address[0]}:{address[1]}"
        self._session = session
        self._variables = (*_OUTPUTS, *(_IO if io else ()))
        self._banks = banks
        self._counter = session  # random, as a first setpoint with the number of an old one would be ignored
        self._closed = threading.Event()
        self._ready = threading.Event()
        self._buffer = bytearray()
        self.newest: Measurement | None = None
        try:
            self._socket = socket.create_connection(address, timeout=_TIMEOUT_S)
        except OSError as error:
            raise UnreachableError(f"no connection to {self._where}: {error}; is the controller on?") from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._set_up(frequency_hz)
            self._socket.setblocking(False)
        except BaseException:
            self._socket.close()
            raise
        self._thread = SupervisedThread(
            self._receive, name=f"{device}-receiver", part="receiver of the driver", device=device
        )
        self._thread.start()
        if not self._ready.wait(_TIMEOUT_S) or self._closed.is_set():
            self.close()
            raise UnreachableError(f"{self._where} sends no valid new measurements; restart the controller")

    @property
    def measurement(self) -> Measurement:
        """The newest measurement.

        Raises:
            UnreachableError: The connection has ended, or the measurement is too old.
        """
        newest = self.newest
        if self._closed.is_set() or newest is None:
            raise UnreachableError(f"the connection to {self._where} is lost")
        if time.monotonic() - newest.at_s > _STALE_S:
            raise UnreachableError(f"{self._where} sends no valid new measurements; check the network")
        return newest

    def command(self, position_rad: Sequence[float]) -> None:
        """Send a setpoint, in the controller's order of the joints.

        Raises:
            UnreachableError: The connection has ended, or the controller does not receive.
        """
        self._counter = (self._counter + 1) % 2**31
        self._send(self._setpoint.pack([self._session, self._counter, *position_rad]))

    def cancel(self) -> None:
        """Let the program not follow the last setpoint any more, also after a pause.

        Raises:
            UnreachableError: As for ``command``.
        """
        self._send(self._cancelled.pack([self._counter]))

    def set_output(self, bank: str, mask: int, values: int) -> None:
        """Set the digital outputs of ``mask`` to the bits of ``values``; ``bank`` is one of the constructor's.

        Raises:
            UnreachableError: As for ``command``.
        """
        self._send(self._output_recipes[bank].pack([mask, values]))

    def end(self) -> None:
        """End the program of this session: it brakes. Neither blocks nor waits for a lock.

        Raises:
            UnreachableError: As for ``command``. The program's watchdog brakes then.
        """
        self._send(self._end.pack([self._session]))

    def close(self) -> None:
        """End the connection and its thread. May be called repeatedly."""
        self._disconnect()
        self._thread.join(_TIMEOUT_S)
        self._socket.close()

    def _set_up(self, frequency_hz: float) -> None:
        setup = rtde.Setup(self._request)
        self._set_up_until_s = time.monotonic() + _TIMEOUT_S
        try:
            setup.check_version()
            self._outputs = setup.outputs(self._variables, frequency_hz)
            self._setpoint = setup.inputs(_SETPOINT)
            self._end = setup.inputs(_END)
            self._cancelled = setup.inputs(_CANCELLED)
            self._output_recipes = {
                bank: setup.inputs([(f"{bank}_digital_output_mask", "UINT8"), (f"{bank}_digital_output", "UINT8")])
                for bank in sorted(self._banks)
            }
            setup.start()
        except OSError as error:
            raise UnreachableError(f"{self._where} does not respond: {error}; is it an RTDE port?") from error
        except rtde.InUseError as error:
            raise UnreachableError(
                f"another program writes '{error}' of {self._where}; end it, or disable the fieldbus adapter"
            ) from error
        except rtde.ProtocolError as error:
            raise DriverError(f"{self._where}: {error}") from error

    def _request(self, kind: int, payload: bytes) -> bytes:
        """Send a package and wait for the response of the same type. Other packages are skipped.

        Raises:
            OSError: There is none in time.
        """
        self._socket.sendall(rtde.package(kind, payload))
        while time.monotonic() < self._set_up_until_s:
            for received, response in rtde.split(self._buffer):
                if received == kind and response:
                    return response
            data = self._socket.recv(4096)
            if not data:
                raise ConnectionError("the connection was closed")
            self._buffer += data
        raise TimeoutError("no valid response")

    def _send(self, data: bytes) -> None:
        try:
            sent = self._socket.send(data)
        except OSError as error:
            self._disconnect()
            raise UnreachableError(f"the connection to {self._where} is lost: {error}") from error
        if sent != len(data):
            self._disconnect()  # the rest would not be a package
            raise UnreachableError(f"{self._where} does not receive; check the network")

    def _disconnect(self) -> None:
        """Wake and end the receiver. It does not free the socket, which another thread may use."""
        self._closed.set()
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            _log.debug("%s: already disconnected", self._where)

    def _receive(self) -> None:
        while not self._closed.is_set():
            try:
                if not select.select([self._socket], [], [], _CHECK_S)[0]:
                    continue
                data = self._socket.recv(65536)
            except BlockingIOError:
                continue
            except (OSError, ValueError):
                break
            if not data:
                break
            self._buffer += data
            for kind, payload in rtde.split(self._buffer):
                if kind == rtde.Package.DATA:
                    self._accept(payload)
        self._closed.set()
        self._ready.set()

    def _accept(self, payload: bytes) -> None:
        """Keep a measurement if it is valid and newer than the previous one. The first one may be old."""
        try:
            measurement = self._parse(payload)
        except ValueError as error:
            _log.debug("%s: package rejected: %s", self._where, error)
            return
        previous = self.newest
        if previous is None or measurement.time_s > previous.time_s:
            self.newest = measurement
            if previous is not None:
                self._ready.set()

    def _parse(self, payload: bytes) -> Measurement:
        """A valid data package.

        Raises:
            ValueError: It does not match the recipe, or a value is impossible, as in the middle of another package.
        """
        values = self._outputs.unpack(payload)
        if not all(map(math.isfinite, values)):
            raise ValueError("a value is not finite")
        time_s, *vectors = values[: 1 + 4 * JOINTS]
        session, beat, robot_mode, safety_mode, runtime_state, *io = values[1 + 4 * JOINTS :]
        session, beat, robot_mode, safety_mode, runtime_state = map(
            int, (session, beat, robot_mode, safety_mode, runtime_state)
        )
        position, velocity, effort, temperature = (
            tuple(vectors[first : first + JOINTS]) for first in range(0, 4 * JOINTS, JOINTS)
        )
        if max(abs(robot_mode), abs(safety_mode)) > _MAX_MODE or runtime_state > _MAX_RUNTIME_STATE:
            raise ValueError("a mode is impossible")
        if max(map(abs, position)) > _MAX_POSITION_RAD:
            raise ValueError("a position is impossible")
        previous = self.newest
        same = previous is not None and (previous.session, previous.beat) == (session, beat)
        stopped = previous is not None and previous.safety_mode == modes.PROTECTIVE_STOP
        return Measurement(
            time_s=time_s,
            position_rad=position,
            velocity_rad_s=velocity,
            effort_nm=effort,
            temperature_c=temperature,
            session=session,
            beat=beat,
            robot_mode=robot_mode,
            safety_mode=safety_mode,
            runtime_state=runtime_state,
            beat_s=previous.beat_s if previous is not None and same else time_s,
            protective_s=previous.protective_s if previous is not None and stopped else time_s,
            at_s=time.monotonic(),
            **_io(io),
        )


def _io(values: Sequence[Any]) -> dict[str, Any]:
    """Fields of a measurement from the values of ``_IO``; none if they are not measured."""
    if not values:
        return {}
    inputs, outputs, first, second, voltage = values
    return {"inputs": inputs, "outputs": outputs, "tool_analog": (first, second), "tool_voltage_v": voltage}
