"""One emulated servo: registers, and a motor that moves towards its goal."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

TIME_CONSTANT_S = 0.05
"""A position servo covers 63 % of the way to its goal in this time [s]."""
MAX_TICKS_S = 3400
"""Highest speed, about 5.2 rad/s [ticks/s]."""


@dataclass(frozen=True, slots=True)
class Table:
    """Registers of a family of servos.

    Attributes:
        registers: Name → address and size in bytes.
        signed: Size of the sign: bit of sign and magnitude, or ``None`` for two's complement.
        velocity_mode: Value of ``Operating_Mode`` in which the servo turns without an end.
        status: Register with the errors.
        overload: Bit of an overload in it.
        impossible: Position that no encoder measures [ticks].
        speed: Register that limits the speed of a position servo, 0: no limit.
        speed_unit: Its unit [ticks/s].
    """

    registers: Mapping[str, tuple[int, int]]
    signed: Mapping[str, int | None]
    velocity_mode: int
    status: str
    overload: int
    impossible: int
    speed: str
    speed_unit: float


class Servo:
    """A servo with 4096 ticks a turn.

    Args:
        table: Its registers.
        values: Initial registers by name.
    """

    def __init__(self, table: Table, values: Mapping[str, int]) -> None:
        self.table = table
        self.memory = bytearray(256)
        self.position = 0.0
        self.velocity = 0.0
        self.loaded = False
        self.writes: list[str] = []
        self._at_s = time.monotonic()
        for name, value in values.items():
            self.set(name, value)
        self.position = float(self.get("Present_Position"))

    def get(self, name: str) -> int:
        """The value of a register."""
        address, size = self.table.registers[name]
        value = int.from_bytes(self.memory[address : address + size], "little")
        if name not in self.table.signed:
            return value
        bit = self.table.signed[name]
        if bit is None:
            return value - (1 << 8 * size) if value >> (8 * size - 1) else value
        magnitude = value & ((1 << bit) - 1)
        return -magnitude if value >> bit & 1 else magnitude

    def set(self, name: str, value: int) -> None:
        """Change a register."""
        address, size = self.table.registers[name]
        bit = self.table.signed.get(name)
        if value < 0 and bit is not None:
            value = -value | 1 << bit
        self.memory[address : address + size] = (value % (1 << 8 * size)).to_bytes(size, "little")

    def write(self, address: int, data: bytes) -> None:
        """Execute a write instruction. The motor moves to now first, so that commands act from now on."""
        self.move()
        self.memory[address : address + len(data)] = data
        self.writes += [name for name, (start, _) in self.table.registers.items() if start == address]

    def read(self, address: int, size: int, *, impossible: bool = False) -> bytes:
        """Execute a read instruction."""
        self.move()
        self.set("Present_Position", self.table.impossible if impossible else round(self.position))
        return bytes(self.memory[address : address + size])

    def overload(self, *, loaded: bool) -> None:
        """Report an overload, or end it. While it lasts, the motor does not move."""
        self.move()
        self.loaded = loaded
        self.set(self.table.status, self.table.overload if loaded else 0)
        if not loaded:
            self.set("Goal_Position", round(self.position))

    @property
    def error(self) -> int:
        """The bits of the errors."""
        return self.get(self.table.status)

    def move(self) -> None:
        """Move the motor to the present time."""
        now_s = time.monotonic()
        elapsed_s, self._at_s = now_s - self._at_s, now_s
        if self.loaded or not self.get("Torque_Enable"):
            self.velocity = 0.0
        elif self.get("Operating_Mode") == self.table.velocity_mode:
            self.velocity = float(self.get("Goal_Velocity"))
            self.position += self.velocity * elapsed_s
        else:
            self._approach(elapsed_s)

    def _approach(self, elapsed_s: float) -> None:
        lower, upper = self.get("Min_Position_Limit"), self.get("Max_Position_Limit")
        goal = min(max(self.get("Goal_Position"), lower), upper)
        limit = self.get(self.table.speed) * self.table.speed_unit or MAX_TICKS_S
        step = (goal - self.position) * (1 - math.exp(-elapsed_s / TIME_CONSTANT_S))
        self.position += min(max(step, -limit * elapsed_s), limit * elapsed_s)
        self.velocity = min(max((goal - self.position) / TIME_CONSTANT_S, -limit), limit)
