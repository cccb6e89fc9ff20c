"""Connects the driver to NAOqi. Runs as a process of its own, under a Python that has the package ``qi``.

It imports nothing of the agent. Its standard input is a socket on which both sides send JSON objects, one a line. The
first line configures it. ``connection.py`` documents the messages. When the agent's side closes, or no command arrives
in time, it stops the robot; see ``robot_services.py``.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import socket
import sys
import threading
import time
from typing import Any

import qi.logging

_CHECK_S = 0.02
_PERIOD_S = 0.02
_STATUS_S = 0.1
_MAX_LINE = 65536


class Bridge:
    """Reads commands and sends measurements."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._sending = threading.Lock()

    def run(self) -> None:
        """Run until the agent's side closes."""
        qi.logging.setLevel(qi.logging.ERROR)
        lines = self._link.makefile("rb")
        config = json.loads(lines.readline(_MAX_LINE))
        try:
            robot = robot_services().Robot(config)
        except (RuntimeError, AttributeError, LookupError, TypeError) as error:
            self.send({"type": "failure", "message": str(error) or repr(error)})
            return
        robot.hold()
        self._end_previous(robot, config.get("unfinished"))
        self.send({"type": "behaviours", "names": robot.installed()})
        robot.find_watchdog()
        for target in (self._measure, self._report, self._watch):
            threading.Thread(target=target, args=(robot,), daemon=True).start()
        try:
            for line in iter(lambda: lines.readline(_MAX_LINE), b""):
                self._accept(robot, json.loads(line))
        except (OSError, ValueError, KeyError) as error:
            sys.stderr.write(f"naoqi bridge: {error!r}\n")
        robot.end()

    def send(self, message: dict[str, Any]) -> None:
        """Send a message, unless the agent has gone."""
        data = json.dumps(message, allow_nan=False).encode() + b"\n"
        try:
            with self._sending:
                self._link.sendall(data)
        except OSError:
            return  # the main thread notices it too, and stops the robot

    def _accept(self, robot: Any, command: dict[str, Any]) -> None:
        if "angles" in command:
            robot.move_joints(command["angles"])
        elif "twist" in command:
            robot.walk(command["twist"])
        elif "hold" in command:
            robot.hold(for_good=True)
        elif "task" in command:
            threading.Thread(target=self._run_task, args=(robot, command), daemon=True).start()
        elif "stop_speech" in command:
            robot.stop_speech()
        elif "end_behaviour" in command:
            robot.end_behaviour()

    def _end_previous(self, robot: Any, unfinished: str | None) -> None:
        """End what a previous bridge has started and could not end."""
        if unfinished is not None:
            if robot.manager is not None and unfinished:
                robot.stop_behaviour(unfinished)
            robot.end_motion()

    def _run_task(self, robot: Any, task: dict[str, Any]) -> None:
        if "behaviour" in task or "script" in task:
            error, held = robot.perform(task)
            self.send({"type": "task", "task": task["task"], "error": error, "held_rad": held})
        else:
            self.send({"type": "task", "task": task["task"], "error": robot.run(task)})

    def _measure(self, robot: Any) -> None:
        self._repeat(robot, robot.measurement, _PERIOD_S)

    def _report(self, robot: Any) -> None:
        self._repeat(robot, robot.status, _STATUS_S)

    def _repeat(self, robot: Any, read: Any, period_s: float) -> None:
        """Send what is valid. Ends the process if the connection to the robot is lost."""
        due_s = time.monotonic()
        while True:
            try:
                self.send(read())
            except (RuntimeError, ValueError, TypeError):
                if not robot.session.isConnected():
                    self.send({"type": "failure", "message": "the robot has closed the connection"})
                    os._exit(1)
            now_s = time.monotonic()
            due_s = max(due_s + period_s, now_s)
            time.sleep(due_s - now_s)

    def _watch(self, robot: Any) -> None:
        while True:
            time.sleep(_CHECK_S)
            robot.beat()
            robot.check()


def robot_services() -> Any:
    """The module ``robot_services`` beside this program. The option ``-I`` leaves this folder out of the path."""
    sys.path.append(os.path.dirname(os.path.abspath(__file__)))  # noqa: PTH100, PTH120 (older Python)
    return importlib.import_module("robot_services")


if __name__ == "__main__":
    for ending in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)  # it ends after the agent, when it has stopped the robot
    Bridge(socket.socket(fileno=os.dup(0))).run()
    os._exit(0)  # the library's threads may hang
