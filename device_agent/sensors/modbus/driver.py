"""Reads and writes the points of one Modbus device."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from pymodbus.client.base import ModbusBaseSyncClient
from pymodbus.pdu import ModbusPDU

from device_agent.ports.sensor import SensorError, Values
from device_agent.protocol.manifests.room import RoomDeviceManifest
from device_agent.sensors.configured_device import SETTINGS, ConfiguredDevice
from device_agent.sensors.conversion import ConversionError
from device_agent.sensors.modbus import bus as buses
from device_agent.sensors.modbus.bus import Bus, ResponseError
from device_agent.sensors.modbus.options import Options, Point, Table

_ILLEGAL_ADDRESS = 2
_MAX_REGISTERS, _MAX_BITS = 125, 2000
"""Largest number of values in one response."""


class _Block(NamedTuple):
    """Adjacent points of one table, which one request reads. ``names``: name of an option → point."""

    table: Table
    start: int
    length: int
    points: Mapping[str, Point]


class ModbusDevice(ConfiguredDevice):
    """See ``RoomDriver``.

    A stream is read with one request for each block of adjacent points. A control is confirmed by reading it again.
    """

    def __init__(self, device: RoomDeviceManifest, options: Options) -> None:
        super().__init__(device, streams=options.streams, controls=options.controls)
        self._options = options
        self._life = threading.Lock()
        self._bus: Bus | None = None
        self._groups: dict[str, Mapping[str, Point]] = dict(options.streams)
        if any(stream.name == SETTINGS for stream in device.streams):
            self._groups.setdefault(SETTINGS, options.controls)
        self._blocks = {name: list(_blocks(points)) for name, points in self._groups.items()}

    def connect(self) -> None:
        """See ``RoomDriver``. Reads all points once, so that a wrong address is found at once."""
        with self._life:
            if self._bus is None:
                self._bus = buses.acquire(self._options)
        for group in self._groups:
            self._read(group)
        if SETTINGS not in self._groups:
            for name in self._options.controls:
                self._read_control(name)

    def read(self, stream: str) -> Values:
        """See ``RoomDriver``."""
        self._require()
        if stream not in self._groups:
            self.reject_unknown("stream", stream, list(self._groups))
        values = self._read(stream)
        return {name: float(value) for name, value in values.items()} if stream == SETTINGS else values

    def set(self, control: str, value: float) -> float:
        """See ``RoomDriver``."""
        self._require()
        if control not in self._options.controls:
            self.reject_unknown("control", control, list(self._options.controls))
        point = self._options.controls[control]
        requested = point.raw(value)
        unit, where = self._options.unit, f"control '{control}' of '{self.device.name}'"
        try:
            if point.is_bit:
                bit = requested >= 0.5  # noqa: PLR2004 (the nearer value)
                self._write(lambda client: client.write_coil(point.address, bit, device_id=unit))
            elif len(registers := point.encode(requested)) == 1:
                self._write(lambda client: client.write_register(point.address, registers[0], device_id=unit))
            else:
                self._write(lambda client: client.write_registers(point.address, registers, device_id=unit))
        except ResponseError as error:
            raise SensorError(f"{where}: the device rejects to write {_place(point)}: {error}") from error
        except ValueError as error:
            raise SensorError(f"{where}: {error}") from error
        block = _Block(point.table, point.address, point.count, {control: point})
        written = bit if point.is_bit else point.decode(registers)
        if (stored := self._read_block("controls", block)[control]) != written:
            raise SensorError(f"{where}: {written:g} was written to {_place(point)}, but the device has {stored:g}")
        return float(self._convert("controls", control, point, stored))

    def close(self) -> None:
        """See ``RoomDriver``."""
        with self._life:
            bus, self._bus = self._bus, None
        if bus is not None:
            buses.release(bus)

    # ------------------------------------------------------------ internal

    def _require(self) -> Bus:
        bus = self._bus
        if bus is None:
            raise self.not_connected()
        return bus

    def _read(self, group: str) -> dict[str, float | bool]:
        """The values of a stream, or of all controls."""
        option = f"streams.{group}" if group in self._options.streams else "controls"
        values: dict[str, float | bool] = {}
        for block in self._blocks[group]:
            try:
                raw = self._read_block(option, block)
            except ResponseError as error:
                if error.code != _ILLEGAL_ADDRESS or len(block.points) == 1:
                    raise self._rejected(option, block, error) from error
                raw = self._read_singly(option, block)
            for name, point in block.points.items():
                values[name] = self._convert(option, name, point, raw[name])
        return values

    def _read_control(self, control: str) -> None:
        point = self._options.controls[control]
        block = _Block(point.table, point.address, point.count, {control: point})
        try:
            raw = self._read_block("controls", block)
        except ResponseError as error:
            raise self._rejected("controls", block, error) from error
        self._convert("controls", control, point, raw[control])

    def _read_singly(self, option: str, block: _Block) -> dict[str, float | bool]:
        """Read each point of a block with a request of its own, which shows the one with the wrong address."""
        raw: dict[str, float | bool] = {}
        for name, point in block.points.items():
            single = _Block(point.table, point.address, point.count, {name: point})
            try:
                raw |= self._read_block(option, single)
            except ResponseError as error:
                raise self._rejected(option, single, error) from error
        return raw

    def _read_block(self, option: str, block: _Block) -> dict[str, float | bool]:
        def send(client: ModbusBaseSyncClient) -> ModbusPDU:
            read = {
                "holding": client.read_holding_registers,
                "input": client.read_input_registers,
                "coil": client.read_coils,
                "discrete": client.read_discrete_inputs,
            }[block.table]
            return read(block.start, count=block.length, device_id=self._options.unit)

        response = self._require().request(send, timeout_s=self._options.timeout_s, write=False)
        bits = block.table in {"coil", "discrete"}
        content: Sequence[int] = response.bits if bits else response.registers
        if len(content) < block.length:
            raise SensorError(
                f"'{self.device.name}' has sent {len(content)} values instead of {block.length} for option '{option}'"
            )
        raw: dict[str, float | bool] = {}
        for name, point in block.points.items():
            own = content[point.address - block.start :][: point.count]
            raw[name] = bool(own[0]) if bits else point.decode([int(word) for word in own])
        return raw

    def _write(self, send: Callable[[ModbusBaseSyncClient], ModbusPDU]) -> None:
        self._require().request(send, timeout_s=self._options.timeout_s, write=True)

    def _convert(self, option: str, name: str, point: Point, raw: float | bool) -> float | bool:
        try:
            return point.value(raw)
        except ConversionError as error:
            raise SensorError(f"option '{option}.{name}' of '{self.device.name}': {name} is {error}") from error

    def _rejected(self, option: str, block: _Block, error: ResponseError) -> SensorError:
        options = ", ".join(f"'{option}.{name}'" for name in block.points)
        places = ", ".join(_place(point) for point in block.points.values())
        return SensorError(f"'{self.device.name}' rejects to read {places}: {error}; check {options} in its options")


def _blocks(points: Mapping[str, Point]) -> Iterator[_Block]:
    """Group adjacent points."""
    names = sorted(points, key=lambda name: (points[name].table, points[name].address))
    current: list[str] = []
    for name in names:
        if current and not _extends(points[current[0]], points[current[-1]], points[name]):
            yield _block({each: points[each] for each in current})
            current = []
        current.append(name)
    if current:
        yield _block({each: points[each] for each in current})


def _extends(first: Point, last: Point, point: Point) -> bool:
    """Whether a point can be read with the points before it."""
    limit = _MAX_BITS if point.is_bit else _MAX_REGISTERS
    return (
        point.table == last.table
        and point.address <= last.address + last.count
        and point.address + point.count - first.address <= limit
    )


def _block(points: Mapping[str, Point]) -> _Block:
    start = min(point.address for point in points.values())
    end = max(point.address + point.count for point in points.values())
    table = next(iter(points.values())).table
    return _Block(table, start, end - start, points)


def _place(point: Point) -> str:
    label = {"holding": "holding register", "input": "input register", "coil": "coil", "discrete": "discrete input"}
    return f"{label[point.table]} {point.address}"
