"""Two-finger gripper of Robotiq, whose URCap on the controller offers a text protocol on port 63352.

Variables have values from 0 to 255. Source: Robotiq, *2F-85 and 2F-140 Instruction Manual*, registers ACT, GTO, POS and
OBJ; the text commands ``GET name`` and ``SET name value`` are those of the URCap.
"""

import contextlib
import socket
import time
from collections.abc import Iterator

from device_agent.ports.skills import BehaviourContext, SkillError

_TIMEOUT_S = 2.0
_MOVE_S = 10.0
"""Longest duration of a motion [s]; at the lowest speed it takes about 5 s."""
_POLL_S = 0.02
_FULL = 255
_ACTIVE = 3
"""Value of STA: the gripper is activated."""
_MOVING, _OBJECTS = 0, (1, 2)
"""Values of OBJ: the fingers move; an object has stopped them. The other value: they have reached the position."""


class Gripper:
    """The gripper of one controller. Each call opens a connection of its own.

    Args:
        host: Host name or IP address of the controller.
        port: Port of the URCap.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)

    def closed(self) -> float:
        """Measured position, from 0 (open) to 1 (closed).

        Raises:
            SkillError: The gripper does not respond.
        """
        with self._open() as link:
            return link.get("POS") / _FULL

    def holds(self) -> bool:
        """Whether an object has stopped the fingers.

        Raises:
            SkillError: The gripper does not respond.
        """
        with self._open() as link:
            return link.get("OBJ") in _OBJECTS

    def move(self, closed: float, context: BehaviourContext) -> float:
        """Move the fingers, until they have arrived or hold an object; returns the measured position, 0 to 1.

        The end of the action stops them.

        Raises:
            SkillError: The gripper is not activated, does not respond or does not arrive.
        """
        target = round(closed * _FULL)
        with self._open() as link:
            if link.get("STA") != _ACTIVE:
                raise SkillError("the gripper is not activated, which moves its fingers; activate it at the robot")
            link.set(POS=target, GTO=1)
            end_s = time.monotonic() + _MOVE_S
            while link.get("PRE") != target or link.get("OBJ") == _MOVING:
                if context.wait(_POLL_S):
                    link.set(GTO=0)
                    break
                if time.monotonic() > end_s:
                    link.set(GTO=0)
                    raise SkillError("the gripper does not arrive; look at its status at the robot")
            return link.get("POS") / _FULL

    @contextlib.contextmanager
    def _open(self) -> Iterator["_Link"]:
        where = f"{self._address[0]}:{self._address[1]}"
        try:
            with socket.create_connection(self._address, timeout=_TIMEOUT_S) as connection:
                yield _Link(connection)
        except (OSError, ValueError) as error:
            raise SkillError(f"no response from the gripper at {where}: {error}; is its URCap installed?") from error


class _Link:
    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def get(self, name: str) -> int:
        received, _, value = self._ask(f"GET {name}").partition(" ")
        if received != name:
            raise ValueError(f"'{received[:80]}' instead of {name}")
        return int(value)

    def set(self, **values: int) -> None:
        response = self._ask("SET " + " ".join(f"{name} {value}" for name, value in values.items()))
        if response != "ack":
            raise ValueError(f"'{response[:80]}' instead of ack")

    def _ask(self, line: str) -> str:
        """Send a command; the response has no defined end of line, so each command waits for one response."""
        self._connection.sendall(line.encode() + b"\n")
        received = self._connection.recv(1024)
        if not received:
            raise ConnectionError("it closed the connection")
        return received.decode("ascii", "replace").strip()
