"""NAOqi's services of one robot, for the bridge process. It imports nothing of the agent.

When no command arrives for ``WATCHDOG_S``, the robot stops. When the connection to it is lost,
``examples/nao/telescope_watchdog.py`` on the robot stops it; without this program the robot does not walk.
"""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
import threading
import time
from typing import Any

import qi

WATCHDOG_S = 0.25
"""Longest time between two commands [s]."""
_CHECK_S = 0.02
_CALL_MS = 500
_CONNECT_MS = 3000
_END_S = 1.8
_LAG_RAD = 0.1
"""Largest distance of a joint that holds from its command [rad]."""
_BEAT, _ECHO = "Telescope/Beat", "Telescope/Echo"
"""Data of ``ALMemory``: a number that changes while the connection works, and its repetition by the watchdog."""
_WATCHDOG_PROGRAM = "the program telescope_watchdog.py on the robot"
_STOPPED = f"{_WATCHDOG_PROGRAM} stopped it: the connection to the robot had failed"
_UNCONFIRMED = f"{_WATCHDOG_PROGRAM} does not respond, and may have stopped it"
_ENDED = "it was ended before its own end"
_ECHO_S = 1.0
"""Longest time until the watchdog has confirmed that it did not stop a behaviour [s]."""
_GUARDED_S = 0.25
"""The robot is guarded for this time after an echo [s]."""
_SENSOR = "Device/SubDeviceList/{}/{}/Value"
_TIME = "DCM/Time"
_FALLEN = "robotHasFallen"
_WALK_END_S = 1.5
"""Longest time of the step that ends a walk [s]; then it is ended in the air."""
_BEHAVIOUR_END_S = 5.0
"""Longest time until the robot has confirmed the end of a behaviour [s]."""


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
        self.manager = self.optional_service("ALBehaviorManager")
        self.address: str = config["url"].rpartition("/")[2]
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
        self._ending: Any = None  # event of the running behaviour or script that ends it
        self._why = ""  # why the event was set
        self._beats = itertools.count(1)
        self._sent = 0
        self._beat: Any = None
        self._echo: Any = None
        self._echoed: Any = None
        self._stops: list[int] | None = None  # how often the watchdog has stopped the robot; empty if it does not count
        self._guarded_s = -math.inf
        self._closing = False  # the connection is ended: no more beats
        call(self.motion.setMoveArmsEnabled, False, False)  # the agent moves the arms, also while the robot walks

    def service(self, name: str) -> Any:
        """A proxy of a service."""
        return self.session.service(name, _async=True).value(_CALL_MS)

    def optional_service(self, name: str) -> Any:
        """A proxy of a service, or ``None`` if the robot does not have it."""
        try:
            return self.service(name)
        except RuntimeError:
            return None

    def installed(self) -> list[str]:
        """Names of the behaviours on the robot."""
        return [] if self.manager is None else [str(name) for name in call(self.manager.getInstalledBehaviors)]

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
        if self._closing or is_running(self._beat) or is_running(self._echo):
            return
        if self._echo is not None and not self._echo.hasError():
            self._accept_echo(self._echo.value())
        self._sent = next(self._beats)
        self._beat = self.memory.insertData(_BEAT, self._sent, _async=True)
        self._echo = self.memory.getData(_ECHO, _async=True)

    def _accept_echo(self, echo: Any) -> None:
        """``echo``: a repeated beat, and the count of stops, which earlier versions of the watchdog do not send."""
        number, *stops = echo if isinstance(echo, (list, tuple)) else [echo]
        if self._echoed not in (None, number):  # the first one may be that of an earlier connection
            self._guarded_s = time.monotonic()
            if self._stops not in (None, stops):
                self.end_behaviour(_STOPPED)
            self._stops = stops
        self._echoed = number

    def move_joints(self, angles: list[float | None]) -> None:
        """Move those joints that have an angle; none while the robot moves itself."""
        targets = {joint: angle for joint, angle in zip(self.joints, angles) if angle is not None}  # noqa: B905
        with self._lock:
            if self._held:
                return
            self._moved_s = time.monotonic()
            if targets and self._ending is None and not is_running(self._angles):
                self._set_angles(targets)

    def walk(self, twist: list[float]) -> None:
        """Walk with a velocity until the next command."""
        with self._lock:
            if self._held or self._ending is not None:
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
                self.end_behaviour(f"the agent sent no commands for {WATCHDOG_S} s")
                self._hold_joints()

    def hold(self, *, for_good: bool = False) -> None:
        """Stop at once. ``for_good``: reject all later commands."""
        self.end_behaviour()
        with self._lock:
            self._held = self._held or for_good
            self.walks, self._moved_s = True, -math.inf
            self._stop_walk()
            self._hold_joints()

    def end(self) -> None:
        """Hold, wait until the robot has confirmed it, and release the robot's watchdog."""
        self._closing = True
        self.hold(for_good=True)
        end_s = time.monotonic() + _END_S
        while (self.walks or self._ending or is_running(self._angles)) and time.monotonic() < end_s:
            time.sleep(_CHECK_S / 4)
            with self._lock:
                if self.walks:
                    self._stop_walk()
        if not self.walks and self._ending is None:
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

    def perform(self, task: dict[str, Any]) -> tuple[str, list[float]]:
        """Run a behaviour or a script to its end, then hold; returns its error, and the angles that are held."""
        with self._lock:
            if self._held or self._ending is not None:
                return "the robot is busy or was halted", []
            self._ending, self._why = threading.Event(), ""
            ending = self._ending
            self._moved_s = time.monotonic()  # the task is a command: the agent must send the next one in time
            stops = self._stops if self.guarded else None
        try:
            error = self._run_script(task, ending) if "script" in task else self._run_behaviour(task, ending)
        except (RuntimeError, OSError) as failure:
            error = str(failure) or "the robot does not respond"
        held = self.end_motion()
        error = error or self._watchdog_report(stops) or self._why or ("" if held else _ENDED)
        with self._lock:
            self._ending = None
        return error, held

    def end_behaviour(self, why: str = _ENDED) -> None:
        """Let a running behaviour or script end. Never blocks."""
        ending = self._ending
        if ending is not None and not ending.is_set():
            self._why = why
            ending.set()

    def _watchdog_report(self, stops: list[int] | None) -> str:
        """What the watchdog did to a behaviour, which continues on the robot after a stop; empty if nothing.

        ``stops``: its count when the behaviour began; ``None`` if it did not run.
        """
        number, end_s = self._sent, time.monotonic() + _ECHO_S
        while stops is not None and not self._held and not self._closing:
            if self._echoed > number:
                return _STOPPED if self._stops != stops else ""
            if time.monotonic() > end_s:
                return _UNCONFIRMED
            time.sleep(_CHECK_S / 4)
        return ""

    def _run_behaviour(self, task: dict[str, Any], ending: Any) -> str:
        name = task["behaviour"]
        if self.manager is None:
            return "the robot has no ALBehaviorManager"
        running = self.manager.runBehavior(name, _async=True)
        while running.isRunning() and not ending.wait(_CHECK_S):
            pass
        if running.isRunning():
            return self.stop_behaviour(name)
        return str(running.error()) if running.hasError() else ""

    def stop_behaviour(self, name: str) -> str:
        """Stop a behaviour until the robot has confirmed it; returns an error."""
        end_s = time.monotonic() + _BEHAVIOUR_END_S
        while call(self.manager.isBehaviorRunning, name):
            call(self.manager.stopBehavior, name)
            if time.monotonic() > end_s:
                return f"the robot does not end '{name}'"
            time.sleep(_CHECK_S)
        return ""

    def _run_script(self, task: dict[str, Any], ending: Any) -> str:
        """Run a program of the owner; its runner kills it when this process closes the runner's input or ends."""
        command = [sys.executable, "-I", task["runner"], task["python"], task["script"], self.address]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as runner:  # noqa: S603
            while runner.poll() is None and not ending.wait(_CHECK_S):
                pass
            return runner.communicate()[0].decode().strip()

    def end_motion(self) -> list[float]:
        """End all motion of the robot's own tasks, and hold; returns the held angles, or none without an answer."""
        try:
            call(self.motion.stopMove)
            call(self.motion.killTasksUsingResources, [joint for joint in self.joints if joint not in self.legs])
            end_s = time.monotonic() + _WALK_END_S
            while call(self.motion.moveIsActive) and time.monotonic() < end_s:
                time.sleep(_CHECK_S)
            call(self.motion.killAll)
            with self._lock:
                self._hold_joints()
            return self.angles(sensors=False)
        except (RuntimeError, ValueError, TypeError):
            return []

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
