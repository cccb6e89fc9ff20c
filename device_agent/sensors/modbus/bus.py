"""Connections to Modbus devices. All devices at one address share one, because a serial line allows only one."""

import logging
import struct
import threading
from collections.abc import Callable
from typing import NamedTuple

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.client.base import ModbusBaseSyncClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from device_agent.ports.sensor import SensorError
from device_agent.sensors.modbus.options import Options

_BUSY_S = 4.0
"""Maximum time to wait for requests of other devices at the same line [s]."""
_MALFORMED = (ValueError, LookupError, TypeError, struct.error)
"""Errors of the library for responses of a defective device."""
_READ_ATTEMPTS = 2
"""Attempts of a read. A device may have closed an idle connection, and a serial line may be disturbed."""
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledged, but not done yet",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
"""Exception code → its name in the specification."""


class ResponseError(Exception):
    """The device has responded with an exception code. The message names it.

    Attributes:
        code: The exception code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code


class _Line(NamedTuple):
    """Where a bus is, and its settings that devices must have in common."""

    where: str
    settings: tuple[object, ...]


class Bus:
    """One connection. Thread-safe: requests are sent one after another.

    Args:
        options: Options of the first device that uses it.
    """

    def __init__(self, options: Options) -> None:
        self.line = _line(options)
        self.users = 0
        self._client = _client(options)
        self._lock = threading.Lock()

    def request(self, send: Callable[[ModbusBaseSyncClient], ModbusPDU], *, timeout_s: float, write: bool) -> ModbusPDU:
        """The response to a request. Reads are repeated once.

        Args:
            send: Sends a request with the client; returns the response.
            timeout_s: Maximum time for the response [s].
            write: Whether the request changes something.

        Raises:
            SensorError: No connection, or no response.
            ResponseError: The device has responded with an exception code.
        """
        if not self._lock.acquire(timeout=_BUSY_S):
            raise SensorError(f"{self.line.where} is busy: another device at this line does not respond")
        try:
            response = self._send(send, timeout_s, attempts=1 if write else _READ_ATTEMPTS)
        finally:
            self._lock.release()
        if response.isError():
            raise ResponseError(response.exception_code)
        return response

    def _send(self, send: Callable[[ModbusBaseSyncClient], ModbusPDU], timeout_s: float, attempts: int) -> ModbusPDU:
        self._client.comm_params.timeout_connect = timeout_s
        while True:
            attempts -= 1
            if not self._client.connect():
                raise SensorError(f"{self.line.where} cannot be opened; {self._advice()}")
            try:
                return send(self._client)
            except (ModbusException, OSError, *_MALFORMED) as error:
                self._client.close()  # type: ignore[no-untyped-call] # a late response must not answer the next request
                if attempts == 0:
                    raise SensorError(
                        f"no valid response at {self.line.where} within {timeout_s:g} s; check power, wiring, `unit` "
                        "and the settings of the line"
                    ) from error

    def close(self) -> None:
        """Close the connection; the next request opens it again."""
        with self._lock:
            self._client.close()  # type: ignore[no-untyped-call]

    def _advice(self) -> str:
        if isinstance(self._client, ModbusTcpClient):
            return "check `host`, `port` and the network"
        return "check that `path` exists, that this user may open it, and that no other program uses it"


def acquire(options: Options) -> Bus:
    """The bus of a device. Each call needs a ``release``.

    Raises:
        SensorError: Another device uses the same line with other settings.
    """
    line = _line(options)
    with _lock:
        bus = _buses.get(line.where)
        if bus is None:
            logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # errors are reported as faults
            bus = _buses[line.where] = Bus(options)
        elif bus.line != line:
            raise SensorError(f"another device uses {line.where} with other settings of the line; make them equal")
        bus.users += 1
        return bus


def release(bus: Bus) -> None:
    """Give a bus back. The last user closes it."""
    with _lock:
        bus.users -= 1
        if bus.users == 0:
            del _buses[bus.line.where]
            bus.close()


def _line(options: Options) -> _Line:
    if options.path:
        return _Line(options.path, (options.baud, options.parity, options.stop_bits))
    return _Line(f"{options.host}:{options.port}", ())


def _client(options: Options) -> ModbusTcpClient | ModbusSerialClient:
    if options.path:
        return ModbusSerialClient(
            options.path,
            baudrate=options.baud,
            parity=options.parity[0].upper(),
            stopbits=options.stop_bits,
            timeout=options.timeout_s,
            retries=0,
        )
    return ModbusTcpClient(options.host, port=options.port, timeout=options.timeout_s, retries=0)


_lock = threading.Lock()
_buses: dict[str, Bus] = {}
"""Open buses by place."""
