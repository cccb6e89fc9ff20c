"""Program: one emulated servo bus on a pseudo-terminal, controlled by JSON lines on its standard input.

The first line is the configuration: ``protocol``, ``port`` (the symbolic link that names the terminal), ``servos``
(id → registers). Each further line is a request; each answer is the state of all servos. It ends with its input.
"""

import importlib
import itertools
import json
import os
import pty
import random
import select
import sys
import tty
from pathlib import Path
from typing import Any

from tests.harness.robots.lerobot.servo import Servo


class Bus:
    """Servos on one line, and what disturbs them."""

    def __init__(self, config: dict[str, Any]) -> None:
        self._protocol = importlib.import_module(f"tests.harness.robots.lerobot.{config['protocol']}")
        self._port = Path(config["port"])
        self.servos = {
            int(servo_id): Servo(self._protocol.TABLE, {**self._protocol.DEFAULTS, "ID": int(servo_id), **values})
            for servo_id, values in config["servos"].items()
        }
        self._random = random.Random(1)
        self._replies = itertools.count(1)
        self._received = b""
        self._disturbance = ""
        self._drop_every = 0
        self._last = b""
        self._late = False
        self._held_back = b""
        self.terminal: int | None = None
        self._other = -1
        self._open()

    def answer(self) -> None:
        """Execute what has arrived on the line."""
        assert self.terminal is not None
        packets, self._received = self._protocol.split(self._received + os.read(self.terminal, 4096))
        for packet in packets:
            replies = self._protocol.execute(packet, self.servos, self._read)
            sent = b"".join(map(self._disturb, replies))
            if self._late and replies:
                self._late, self._held_back = False, sent
            elif sent:
                os.write(self.terminal, self._held_back + sent)
                self._held_back = b""

    def control(self, request: dict[str, Any]) -> dict[str, Any]:
        """Execute a request; returns the state of all servos."""
        if "disturb" in request:
            self._start(request["disturb"])
        if request.get("restore"):
            self._restore()
        self._drop_every = request.get("drop_every", self._drop_every)
        self._late = request.get("late", self._late)
        for servo_id, values in request.get("set", {}).items():
            self._set(self.servos[int(servo_id)], values)
        return {str(servo_id): self._state(servo) for servo_id, servo in self.servos.items()}

    def close(self) -> None:
        """Remove the terminal."""
        if self.terminal is not None:
            os.close(self.terminal)
            os.close(self._other)
            self._port.unlink(missing_ok=True)
        self.terminal, self._received = None, b""

    def _open(self) -> None:
        self.terminal, self._other = pty.openpty()
        tty.setraw(self._other)
        self._port.symlink_to(os.ttyname(self._other))

    def _start(self, disturbance: str) -> None:
        self._disturbance = disturbance
        if disturbance == "connection":
            self.close()
        for servo in self.servos.values() if disturbance == "safety" else ():
            servo.overload(loaded=True)

    def _restore(self) -> None:
        if self.terminal is None:
            self._open()
        for servo in self.servos.values():
            if servo.loaded:
                servo.overload(loaded=False)
        self._disturbance, self._drop_every = "", 0

    def _set(self, servo: Servo, values: dict[str, int]) -> None:
        servo.move()
        for name, value in values.items():
            servo.set(name, value)
        if "Present_Position" in values:
            servo.position = values["Present_Position"]

    def _read(self, servo: Servo, address: int, size: int) -> bytes:
        return servo.read(address, size, impossible=self._disturbance == "nan")

    def _disturb(self, reply: bytes) -> bytes:
        """The bytes that arrive instead of a reply."""
        if self._drop_every and next(self._replies) % self._drop_every == 0:
            return b""
        spoiled = {
            "silence": b"",
            "garbage": self._random.randbytes(len(reply)),
            "truncated": reply[: len(reply) // 2],
            "checksum": reply[:-1] + bytes((reply[-1] ^ 1,)),
            "clock": self._last,  # an adapter that hangs repeats its buffer
        }
        if self._disturbance in spoiled:
            return spoiled[self._disturbance]
        self._last = reply
        return reply

    def _state(self, servo: Servo) -> dict[str, Any]:
        servo.move()
        writes, servo.writes = servo.writes, []
        registers = {name: servo.get(name) for name in servo.table.registers}
        return {**registers, "position": servo.position, "velocity": servo.velocity, "writes": writes}


def main() -> None:
    """Run until the standard input ends."""
    bus = Bus(json.loads(sys.stdin.readline()))
    sys.stdout.write("{}\n")
    sys.stdout.flush()
    while True:
        # The terminal comes first, because a request may close it.
        sources = [*([] if bus.terminal is None else [bus.terminal]), sys.stdin]
        for source in select.select(sources, [], [])[0]:
            if isinstance(source, int):
                bus.answer()
            elif line := sys.stdin.readline():
                sys.stdout.write(json.dumps(bus.control(json.loads(line))) + "\n")
                sys.stdout.flush()
            else:
                bus.close()
                return


if __name__ == "__main__":
    main()
