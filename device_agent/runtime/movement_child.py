"""The other side of ``movements``: runs one movement script in a process of its own.

Started as ``python -I -B movement_child.py FD`` and imports the standard library alone. It speaks to the agent over one
inherited socket, a JSON object per line: first it reads ``{"source", "name", "parameters", "joints"}``, then it asks
``{"call", "arguments"}`` and reads ``{"value"}`` or ``{"error"}``; ``{"output"}`` carries prints and ``{"progress"}``
a share 0…1; ``{"ended"}`` closes, with an ``error`` that names the script's line where there was one.
"""

import io
import json
import socket
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any


class RobotError(Exception):
    """The robot did not do what the script asked; says why. Ends the script unless it is caught."""


class Link:
    """Lines of JSON over the inherited socket."""

    def __init__(self, descriptor: int) -> None:
        self._lines = socket.socket(fileno=descriptor).makefile("rw", encoding="utf-8", newline="\n")

    def read(self) -> dict[str, Any]:
        """The next message; the process ends when the agent has gone."""
        line = self._lines.readline()
        if not line:
            raise SystemExit(1)
        message: dict[str, Any] = json.loads(line)
        return message

    def write(self, **message: Any) -> None:
        """One message; numbers that are not finite are an error here, in the script's own line."""
        self._lines.write(json.dumps(message, allow_nan=False) + "\n")
        self._lines.flush()

    def call(self, call: str, **arguments: Any) -> Any:
        """Ask the agent and wait for its answer."""
        self.write(call=call, arguments=arguments)
        answer = self.read()
        if "error" in answer:
            raise RobotError(answer["error"])
        return answer.get("value")


class Robot:
    """``robot`` in a movement script."""

    def __init__(self, link: Link, joints: Sequence[str]) -> None:
        self._link = link
        self.joints = tuple(joints)

    def move_joints(self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5) -> None:
        """Move and wait until there.

        Args:
            position_rad: Joint name → position [rad], or a list in the order of ``robot.joints``.
            speed: Share of each joint's velocity limit, above 0, up to 1.
        """
        if not isinstance(position_rad, Mapping):
            if len(position_rad) != len(self.joints):
                raise RobotError(
                    f"{len(position_rad)} positions for {len(self.joints)} joints: {', '.join(self.joints)}"
                )
            position_rad = dict(zip(self.joints, position_rad, strict=True))
        targets = {name: float(value) for name, value in position_rad.items()}
        self._link.call("move_joints", position_rad=targets, speed=float(speed))

    def home(self, speed: float = 0.5) -> None:
        """Move to the robot type's home position and wait until there."""
        self._link.call("home", speed=float(speed))

    def state(self) -> dict[str, Any]:
        """Measured ``position_rad``, ``velocity_rad_s``, ``effort_nm`` by joint name, and ``mode``."""
        state: dict[str, Any] = self._link.call("state")
        return state


class Output(io.TextIOBase):
    """Where a script prints to: the operator's page."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def write(self, text: str) -> int:
        """Send what was printed."""
        if text:
            self._link.write(output=text)
        return len(text)

    def writable(self) -> bool:
        """Yes."""
        return True


def main(descriptor: int) -> None:
    """Run the script that the agent sends."""
    link = Link(descriptor)
    task = link.read()
    filename = f"{task['name']}.py"
    sys.stdout = sys.stderr = Output(link)
    given = {
        "__name__": "__movement__",
        "robot": Robot(link, task["joints"]),
        "parameters": task["parameters"],
        "wait": time.sleep,
        "progress": lambda share: link.write(progress=float(share)),
        "RobotError": RobotError,
    }
    try:
        exec(compile(task["source"], filename, "exec"), given)  # noqa: S102 (the purpose of this process)
    except BaseException as error:  # noqa: BLE001 (whatever a script raises is an answer, not a crash)
        link.write(ended=True, error=_explain(error, filename))
    else:
        link.write(ended=True)


def _explain(error: BaseException, filename: str) -> str:
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, SyntaxError) and error.filename == filename:
        return f"line {error.lineno}: {text}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == filename]
    return f"line {lines[-1]}: {text}" if lines else text


if __name__ == "__main__":
    main(int(sys.argv[1]))
