"""pymodbus's own server as the peer of the driver, over TCP or a serial line."""

import asyncio
import struct
import threading
from collections.abc import Sequence
from typing import Any, Self

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import SimData, SimDevice

from tests.harness.network.brokers import HOST, PATIENCE_S
from tests.harness.network.ports import free_port

SIZE = 64
"""Number of addresses in each table; the next one is illegal."""
TABLES = {1: "coil", 2: "discrete", 3: "holding", 4: "input", 5: "coil", 6: "holding", 15: "coil", 16: "holding"}


def words(kind: str, value: float) -> list[int]:
    """Registers with a value in big-endian order; ``kind`` as in ``struct``."""
    data = struct.pack(f">{kind}", value)
    return [int.from_bytes(data[start : start + 2], "big") for start in range(0, len(data), 2)]


class ModbusPeer:
    """A server with one unit, in a thread; a context manager that stops it.

    Attributes:
        tables: Table → values by address.
        fault: Exception with which every request is answered.
        silent: Whether the server answers nothing.
        ignore_writes: Whether writes are confirmed but not done.
        requests: Function code, address and count of each request.
        place: Options of the driver with which it is reached; set by the test.
    """

    def __init__(self, *, path: str = "", port: int = 0, unit: int = 1) -> None:
        self.tables: dict[str, list[int]] = {name: [0] * SIZE for name in set(TABLES.values())}
        self.fault: ExcCodes | None = None
        self.silent = self.ignore_writes = False
        self.requests: list[tuple[int, int, int]] = []
        self.port = port or free_port()
        self.place: dict[str, Any] = {}
        self._path = path
        self._unit = unit
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),), daemon=True)
        self._thread.start()
        assert self._ready.wait(PATIENCE_S)

    def put(self, table: str, address: int, values: Sequence[int]) -> None:
        self.tables[table][address : address + len(values)] = values

    async def _serve(self) -> None:
        unused = SimDevice(self._unit, SimData(0, values=0))
        common: dict[str, Any] = {"trace_packet": self._trace}
        if self._path:
            server: Any = ModbusSerialServer(unused, port=self._path, baudrate=9600, **common)
        else:
            server = ModbusTcpServer(unused, address=(HOST, self.port), **common)
        server.context = self
        await server.serve_forever(background=True)
        self._ended = asyncio.Event()
        self._ready.set()
        await self._ended.wait()
        await server.shutdown()

    def device_ids(self) -> list[int]:
        """See ``pymodbus.simulator.SimCore``, as the following."""
        return [self._unit]

    async def async_getValues(  # noqa: N802 (pymodbus's name)
        self, device_id: int, function: int, address: int, count: int = 1
    ) -> list[int] | ExcCodes:
        assert device_id == self._unit
        self.requests.append((function, address, count))
        if not self._has(address, count):
            return ExcCodes.ILLEGAL_ADDRESS
        return self.fault or self.tables[TABLES[function]][address : address + count]

    async def async_setValues(  # noqa: N802 (pymodbus's name)
        self, device_id: int, function: int, address: int, values: list[int]
    ) -> ExcCodes | None:
        assert device_id == self._unit
        if not self._has(address, len(values)):
            return ExcCodes.ILLEGAL_ADDRESS
        if self.fault is None and not self.ignore_writes:
            self.put(TABLES[function], address, [int(value) for value in values])
        return self.fault

    @staticmethod
    def _has(address: int, count: int) -> bool:
        return address + count <= SIZE

    def _trace(self, sending: bool, data: bytes) -> bytes:
        return b"" if sending and self.silent else data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(PATIENCE_S)
        self._loop.close()
