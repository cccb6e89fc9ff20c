"""Options of the driver ``modbus``, and the encoding of values in registers.

Source: MODBUS Application Protocol Specification V1.1b3, https://modbus.org/specs.php
"""

import struct
from typing import Annotated, Literal

from msgspec import Meta, Struct

from device_agent.protocol import Field, Id
from device_agent.sensors.conversion import Conversion

Address = Annotated[int, Meta(ge=0, le=65_535)]
Table = Literal["holding", "input", "coil", "discrete"]
_FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_WORD = 2
"""Size of a register [bytes]."""


class Point(Conversion, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A value in the registers, or a bit.

    Attributes:
        address: Address of the first register or of the bit, counted from 0, as in the protocol.
        table: ``holding`` or ``input`` registers; ``coil`` or ``discrete`` bits.
        type: Type of the value in registers.
        word_order: Which register of a 32-bit value is first: that with the high half (``big``) or the low half.
        byte_order: Order of the bytes in each register; the protocol uses ``big``.
    """

    address: Address
    table: Table = "holding"
    type: Literal["int16", "uint16", "int32", "uint32", "float32"] = "int16"
    word_order: Literal["big", "little"] = "big"
    byte_order: Literal["big", "little"] = "big"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address + self.count > 65_536:  # noqa: PLR2004 (the address space)
            raise ValueError("the value ends after address 65535")

    @property
    def is_bit(self) -> bool:
        """Whether it is a bit."""
        return self.table in {"coil", "discrete"}

    @property
    def count(self) -> int:
        """Number of registers, or 1 for a bit."""
        return 1 if self.is_bit else struct.calcsize(_FORMATS[self.type]) // _WORD

    def decode(self, registers: list[int]) -> float:
        """The raw value in registers."""
        words = [register.to_bytes(_WORD, self.byte_order) for register in registers]
        if self.word_order == "little":
            words.reverse()
        value: float = struct.unpack(_FORMATS[self.type], b"".join(words))[0]
        return value

    def encode(self, raw: float) -> list[int]:
        """Registers with a raw value; integers are rounded.

        Raises:
            ValueError: The type has no such value.
        """
        try:
            data = struct.pack(_FORMATS[self.type], raw if self.type == "float32" else round(raw))
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{raw:g} is not a value of {self.type}") from error
        words = [data[start : start + _WORD] for start in range(0, len(data), _WORD)]
        if self.word_order == "little":
            words.reverse()
        return [int.from_bytes(word, self.byte_order) for word in words]


class ControlPoint(Point, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A value that can be set: in holding registers, or a coil."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.table not in {"holding", "coil"}:
            raise ValueError("a control needs a table that can be written: `holding` or `coil`")


class Options(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver. Devices with the same ``host`` and ``port``, or ``path``, share one connection.

    Attributes:
        host: Host name or address of the device or gateway; empty: the device is at a serial line.
        port: TCP port.
        path: Serial port: ``/dev/ttyUSB0``; empty: TCP.
        baud: Speed of the serial line [bit/s].
        parity: ``none``, ``even`` or ``odd``.
        stop_bits: Number of stop bits.
        unit: Unit identifier of the device.
        timeout_s: Maximum time for a response [s].
        streams: Stream → quantity → point. A stream is read as a whole.
        controls: Control → point.
    """

    host: Annotated[str, Meta(max_length=255)] = ""
    port: Annotated[int, Meta(ge=1, le=65_535)] = 502
    path: Annotated[str, Meta(max_length=255)] = ""
    baud: Annotated[int, Meta(ge=300, le=1_000_000)] = 9600
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Literal[1, 2] = 1
    unit: Annotated[int, Meta(ge=0, le=255)] = 1
    timeout_s: Annotated[float, Meta(ge=0.05, le=2)] = 1.0
    streams: dict[Id, dict[Field, Point]] = {}
    controls: dict[Id, ControlPoint] = {}

    def __post_init__(self) -> None:
        if bool(self.host) == bool(self.path):
            raise ValueError("either `host` (Modbus TCP) or `path` (a serial line) is needed")
