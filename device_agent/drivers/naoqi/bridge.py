"""Connects the driver to NAOqi. Runs as a process of its own, under a Python that has the package ``qi``.

It imports nothing of the agent. Its standard input is a socket on which both sides send JSON objects, one a line. The
first line configures it. ``connection.py`` documents the messages. When the agent's side closes, or no command arrives
for ``WATCHDOG_S``, it stops the robot. When it loses the robot, ``examples/nao/telescope_watchdog.py`` on the robot
does so; without this program the robot does not walk.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import socket
import sys
import threading
import time
from typing import Any

import qi
import qi.logging

WATCHDOG_S = 0.25
"""Longest time between two commands [s]."""
_CHECK_S = 0.02
_PERIOD_S = 0.02
_STATUS_S = 0.1
_CALL_MS = 500
_CONNECT_MS = 3000
_END_S = 1.0
_LAG_RAD = 0.1
"""Largest distance of a joint that holds from its command [rad]."""
_MAX_LINE = 65536
_BEAT, _ECHO = "Telescope/Beat", "Telescope/Echo"
"""Data of ``ALMemory``: a number that changes while the connection works, and its repetition by the watchdog."""
_GUARDED_S = 0.25
"""The robot is guarded for this time after an echo [s]."""
_SENSOR = "Device/SubDeviceList/{}/{}/Value"
_TIME = "DCM/Time"
_FALLEN = "robotHasFallen"


class Robot:
    """The robot's services. Commands never wait for an answer, and at most one of each kind is outstanding."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.session = qi.Session()
        self.session.connect(config["url"], _async=True).value(_CONNECT_MS)
        self.motion = self.service("ALMotion")
        self.memory = self.service("ALMemory")
        self.posture = self.service("ALRobotPosture")
        self.battery = self.service("ALBattery")
        self.speech = self.service("ALTextToSpeech")
        self.joints: list[str] = config["joints"]
        self.legs = set(config["legs"])
        self.language = str(call(self.speech.getLanguage))
        limits = [call(self.motion.getLimits, joint)[0] for joint in self.joints]
        shares = [limit / row[2] for limit, row in zip(config["velocity_rad_s"], limits)]  # noqa: B905 (older Python)
        self.fraction = min(1.0, *shares)
        self.walks = False
        self._walked_s = -math.inf
        self._moved_s = math.inf
        self._held = False
        self._lock = threading.Lock()
        self._angles: Any = None
        self._move: Any = None
        self._stop: Any = None
        self._stop_is_last = False
        self._beats = itertools.cycle(range(1, 1 << 30))
        self._beat: Any = None
        self._echo: Any = None
        self._echoed: Any = None
        self._guarded_s = -math.inf
        self._ending = False
        call(self.motion.setMoveArmsEnabled, False, False)  # the agent moves the arms, also while the robot walks

    def service(self, name: str) -> Any:
        """A proxy of a service."""
        return self.session.service(name, _async=True).value(_CALL_MS)

    @property
    def guarded(self) -> bool:
        """Whether the robot stops by itself if the connection to it is lost."""
        return time.monotonic() - self._guarded_s < _GUARDED_S

    def find_watchdog(self) -> None:
        """Beat until the first echo, so that the first status is true. Without a watchdog it takes a moment."""
        end_s = time.monotonic() + _GUARDED_S
        while not self.guarded and time.monotonic() < end_s:
            self.beat()
            time.sleep(_CHECK_S / 4)

    def beat(self) -> None:
        """Show the robot's watchdog that the connection works, and read its echo."""
        if self._ending or is_running(self._beat) or is_running(self._echo):
            return
        if self._echo is not None and not self._echo.hasError():
            echo = self._echo.value()
            if self._echoed not in (None, echo):  # the first one may be that of an earlier connection
                self._guarded_s = time.monotonic()
            self._echoed = echo
        self._beat = self.memory.insertData(_BEAT, next(self._beats), _async=True)
        self._echo = self.memory.getData(_ECHO, _async=True)

    def move_joints(self, angles: list[float | None]) -> None:
        """Move those joints that have an angle."""
        targets = {joint: angle for joint, angle in zip(self.joints, angles) if angle is not None}  # noqa: B905
        with self._lock:
            if self._held:
                return
            self._moved_s = time.monotonic()
            if not is_running(self._angles):
                self._set_angles(targets)

    def walk(self, twist: list[float]) -> None:
        """Walk with a velocity until the next command."""
        with self._lock:
            if self._held:
                return
            self._walked_s = time.monotonic()
            if not any(twist) or not self.guarded:
                self._stop_walk()
            elif not is_running(self._move):
                self.walks, self._stop_is_last = True, False
                self._move = self.motion.move(*twist, _async=True)

    def check(self) -> None:
        """Stop what is no longer commanded. Repeated until the robot has confirmed it."""
        with self._lock:
            now_s = time.monotonic()
            if self.walks and now_s - self._walked_s > WATCHDOG_S:
                self._stop_walk()
            if now_s - self._moved_s > WATCHDOG_S:
                self._hold_joints()

    def hold(self, *, for_good: bool = False) -> None:
        """Stop at once. ``for_good``: reject all later commands."""
        with self._lock:
            self._held = self._held or for_good
            self.walks, self._moved_s = True, -math.inf
            self._stop_walk()
            self._hold_joints()

    def end(self) -> None:
        """Hold, wait until the robot has confirmed it, and release the robot's watchdog."""
        self._ending = True
        self.hold(for_good=True)
        end_s = time.monotonic() + _END_S
        while (self.walks or is_running(self._angles)) and time.monotonic() < end_s:
            time.sleep(_CHECK_S / 4)
            with self._lock:
                if self.walks:
                    self._stop_walk()
        if not self.walks:
            if self._beat is not None:
                self._beat.wait(_CALL_MS)
            self.memory.insertData(_BEAT, 0, _async=True).wait(_CALL_MS)

    def angles(self, *, sensors: bool = True) -> list[float]:
        """Measured angles [rad], or those that NAOqi commands now on the way to their targets."""
        return numbers(call(self.motion.getAngles, self.joints, sensors), len(self.joints))

    def measurement(self) -> dict[str, Any]:
        """Joints and the robot's own time [ms]."""
        at_s = time.monotonic()
        clock = self.memory.getData(_TIME, _async=True)
        angles = self.angles()
        (time_ms,) = numbers([clock.value(_CALL_MS)], 1)
        return {"type": "measurement", "at_s": at_s, "time_ms": time_ms, "position_rad": angles}

    def status(self) -> dict[str, Any]:
        """All that changes slowly."""
        at_s, count = time.monotonic(), len(self.joints)
        keys = [_SENSOR.format(joint, "Temperature/Sensor") for joint in self.joints]
        return {
            "type": "status",
            "at_s": at_s,
            "stiffness": numbers(call(self.motion.getStiffnesses, self.joints), count),
            "temperature_c": numbers(call(self.memory.getListData, keys), count),
            "fallen": bool(call(self.memory.getData, _FALLEN)),
            "fall_manager": bool(call(self.motion.getFallManagerEnabled)),
            "posture": str(call(self.posture.getPostureFamily)),
            "walks": bool(call(self.motion.moveIsActive)),
            "pose": numbers(call(self.motion.getRobotPosition, True), 3),
            "twist": numbers(call(self.motion.getRobotVelocity), 3),
            "guarded": self.guarded,
            "battery_percent": numbers([call(self.battery.getBatteryCharge)], 1)[0],
        }

    def run(self, task: dict[str, Any]) -> str:
        """Execute a task to its end; returns its error."""
        try:
            if "say" in task:
                call(self.speech.setLanguage, task["language"] or self.language)
                self.speech.say(task["say"])
            elif "stiffness" in task:
                call(self.motion.setStiffnesses, task["joints"], task["stiffness"])
        except RuntimeError as error:
            return str(error) or "NAOqi has rejected it"
        return ""

    def stop_speech(self) -> None:
        """End all speech."""
        self.speech.stopAll(_async=True)

    def _hold_joints(self) -> None:
        """Keep the present command, which carries the load, or the measured angle where they differ much.

        NAOqi itself ends a walk, so its legs are left alone.
        """
        try:
            if self._angles is not None:
                self._angles.wait(_CALL_MS)  # services run calls in parallel; this one comes last
            targets = {}
            for joint, measured, command in zip(self.joints, self.angles(), self.angles(sensors=False)):  # noqa: B905
                targets[joint] = command if abs(command - measured) < _LAG_RAD else measured
            if call(self.motion.moveIsActive):
                targets = {joint: angle for joint, angle in targets.items() if joint not in self.legs}
            self._set_angles(targets)
            self._moved_s = math.inf
        except (RuntimeError, ValueError, TypeError):
            return  # the next check repeats it

    def _set_angles(self, targets: dict[str, float]) -> None:
        self._angles = self.motion.setAngles(list(targets), list(targets.values()), self.fraction, _async=True)

    def _stop_walk(self) -> None:
        """Send a stop, or note a confirmed one. A stop sent before a walk was answered is followed by another."""
        if self._stop is not None and not self._stop.isRunning():
            confirmed = self._stop_is_last and not self._stop.hasError()
            self._stop = None
            if confirmed:
                self.walks = False
        if self._stop is None and self.walks:
            self._stop_is_last = not is_running(self._move)
            self._stop = self.motion.stopMove(_async=True)


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
            robot = Robot(config)
        except (RuntimeError, AttributeError, LookupError, TypeError) as error:
            self.send({"type": "failure", "message": str(error) or repr(error)})
            return
        robot.hold()
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

    def _accept(self, robot: Robot, command: dict[str, Any]) -> None:
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

    def _run_task(self, robot: Robot, task: dict[str, Any]) -> None:
        self.send({"type": "task", "task": task["task"], "error": robot.run(task)})

    def _measure(self, robot: Robot) -> None:
        self._repeat(robot, robot.measurement, _PERIOD_S)

    def _report(self, robot: Robot) -> None:
        self._repeat(robot, robot.status, _STATUS_S)

    def _repeat(self, robot: Robot, read: Any, period_s: float) -> None:
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

    def _watch(self, robot: Robot) -> None:
        while True:
            time.sleep(_CHECK_S)
            robot.beat()
            robot.check()


def is_running(future: Any) -> bool:
    """Whether a call is unanswered."""
    return future is not None and bool(future.isRunning())


def call(method: Any, *arguments: Any) -> Any:
    """The result of a call. Raises ``RuntimeError`` if there is none in time."""
    return method(*arguments, _async=True).value(_CALL_MS)


def numbers(values: Any, count: int) -> list[float]:
    """Finite numbers. Raises ``ValueError`` or ``TypeError`` for anything else."""
    result = [float(value) for value in values if not isinstance(value, (str, bytes))]
    if len(result) != count or not all(map(math.isfinite, result)):
        raise ValueError("not the expected number of finite values")
    return result


if __name__ == "__main__":
    for ending in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)  # it ends after the agent, when it has stopped the robot
    Bridge(socket.socket(fileno=os.dup(0))).run()
    os._exit(0)  # the library's threads may hang
