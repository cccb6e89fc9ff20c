"""Runs a movement script: a process of its own whose only way to the robot is one socket to this agent."""

import contextlib
import json
import math
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from device_agent.protocol.messages import RunMovement
from device_agent.runtime.lease import Refused

_CHILD = Path(__file__).with_name("movement_child.py")
_LONGEST_LINE = 1 << 20
MAX_OUTPUT = 2000
"""Characters of printed output that an ack carries; of more, the newest are kept."""


class ScriptRobot(Protocol):
    """What a script may ask of its robot. Each method blocks until it is done.

    All of them raise ``Refused`` when the robot does not do it.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names in order."""

    def move_joints(self, position_rad: dict[str, float], speed: float) -> None:
        """Move and wait until there [rad]."""

    def home(self, speed: float) -> None:
        """Move home and wait until there."""

    def state(self) -> dict[str, Any]:
        """The newest measurement, by joint name."""


class ScriptFailed(Exception):  # noqa: N818 (an outcome to report)
    """The script ended with an error; the text names its line."""


class Script:
    """One run of one movement script.

    Args:
        order: Source, name and parameters.
        robot: What its calls reach.
        told: Called with what the script printed last and its progress 0…1, if it gave one.
    """

    def __init__(self, order: RunMovement, robot: ScriptRobot, told: Callable[[str, float | None], None]) -> None:
        self._order = order
        self._robot = robot
        self._told = told
        self._killed = False
        self._process: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        """Run to the end.

        Raises:
            ScriptFailed: The script raised, or its process died.
        """
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                self._process = subprocess.Popen(  # noqa: S603 (our own file, run by our own interpreter)
                    [sys.executable, "-I", "-B", str(_CHILD), str(theirs.fileno())],
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    env={},
                    cwd="/",
                    start_new_session=True,
                )
            if self._killed:
                self._process.kill()
            self._serve(ours)
        finally:
            self.kill()
            ours.close()
            if self._process is not None:
                self._process.wait()

    def kill(self) -> None:
        """End the process at once, from any thread; ``run`` then raises. May be called twice."""
        # No lock: the control loop may call this, and must not wait for a process to be started.
        self._killed = True
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()

    def _serve(self, ours: socket.socket) -> None:
        try:
            with ours.makefile("rwb") as lines:
                self._write(
                    lines,
                    source=self._order.source,
                    name=self._order.name,
                    parameters=self._order.parameters,
                    joints=self._robot.joints,
                )
                while (message := self._read(lines)) is not None:
                    self._answer(lines, message)
        except (OSError, ValueError) as error:
            raise ScriptFailed(f"the script's process ended before the script did ({error})") from error

    @staticmethod
    def _read(lines: Any) -> dict[str, Any] | None:
        """The next message, or ``None`` when the script has ended well."""
        line = lines.readline(_LONGEST_LINE)
        message = json.loads(line, parse_constant=_no_constant) if line.endswith(b"\n") else None
        if not isinstance(message, dict):
            raise ScriptFailed("the script's process ended before the script did")
        if "ended" not in message:
            return message
        if message.get("error"):
            raise ScriptFailed(str(message["error"])[:MAX_OUTPUT])
        return None

    def _answer(self, lines: Any, message: dict[str, Any]) -> None:
        if "output" in message:
            self._told(str(message["output"]), None)
        elif "progress" in message:
            self._told("", min(max(_number(message["progress"]), 0.0), 1.0))
        else:
            try:
                self._write(lines, value=self._call(message.get("call"), message.get("arguments") or {}))
            except Refused as refused:
                self._write(lines, error=refused.message)

    def _call(self, call: Any, arguments: dict[str, Any]) -> Any:
        if call == "state":
            return self._robot.state()
        speed = _number(arguments.get("speed"))
        if not 0 < speed <= 1:
            raise Refused("bad_speed", f"speed must be above 0 and at most 1, not {speed}")
        if call == "home":
            return self._robot.home(speed)
        if call == "move_joints":
            wanted = arguments.get("position_rad")
            if not isinstance(wanted, dict) or not wanted:
                raise Refused("bad_positions", "move_joints needs at least one joint and its position")
            return self._robot.move_joints({str(name): _number(value) for name, value in wanted.items()}, speed)
        raise Refused("unknown_call", f"there is no robot.{str(call)[:80]}")

    @staticmethod
    def _write(lines: Any, **message: Any) -> None:
        lines.write(json.dumps(message, allow_nan=False).encode() + b"\n")
        lines.flush()


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise Refused("bad_number", f"{str(value)[:80]} is not a finite number")
    return float(value)


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")
