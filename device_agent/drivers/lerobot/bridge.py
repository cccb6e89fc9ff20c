"""Connects the driver to LeRobot's robot classes. Runs as a process of its own, under a Python that has ``lerobot``.

It imports nothing of the agent. Its standard input is a socket on which both sides send JSON objects, one a line. The
first line configures it. ``connection.py`` documents the messages. When the agent's side closes, or no command arrives
for ``WATCHDOG_S``, it stops the robot. One thread uses the bus.
"""

from __future__ import annotations

import collections
import contextlib
import importlib
import itertools
import json
import math
import os
import signal
import socket
import sys
import termios
import threading
import time
import types
from pathlib import Path
from typing import Any

WATCHDOG_S = 0.25  # between two commands
_PERIOD_S = 0.02
_END_S = 1.0
_TRIES = 3
_LATE_MS = 100
_LAG_TICKS = 65
"""Largest distance of a joint that holds from its goal, 0.1 rad [ticks]."""
_TICKS = 4096  # of a turn
_MAX_LINE = 65536
_HISTORY = 100

UNUSED = ("cv2", "lerobot.lerobot_types", "lerobot.processor", "lerobot.utils.device_utils", "lerobot.utils.utils")
"""Modules that LeRobot 0.4 or 0.6 imports with its robot classes, for cameras and training. They need 5 GB."""
_LOST = (ConnectionError, RuntimeError, ValueError, TypeError, LookupError)
"""What LeRobot and the libraries of the servos raise if a response is missing or wrong."""
_FAILED = (*_LOST, OSError, termios.error)  # also if the port is gone


class Placeholder(types.ModuleType):
    """A module whose names are empty classes."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class RobotError(Exception):
    """The robot cannot be used. The message is shown to operators."""


class Robot:
    """One robot of LeRobot. Only ``accept`` and ``stop`` may be called by another thread."""

    def __init__(self, config: dict[str, Any]) -> None:
        sys.modules.update({name: Placeholder(name) for name in UNUSED})
        try:
            robot_class = getattr(importlib.import_module(config["module"]), config["name"])
            self.robot = robot_class(
                robot_class.config_class(
                    port=config["port"],
                    id=config["id"],
                    calibration_dir=Path(config["calibration"]).expanduser() if config["calibration"] else None,
                    cameras={},
                    use_degrees=True,
                    disable_torque_on_disconnect=False,
                )
            )
        except ImportError as error:
            raise RobotError(f"LeRobot is not complete ({error}); see docs/robots/lerobot.md") from error
        self.robot.config.num_read_retries = 0  # LeRobot 0.6 takes a late response for that of a repeated request
        self.bus = self.robot.bus
        self.port: str = config["port"]
        self.registers: dict[str, str] = config["registers"]
        self.joints: list[str] = config["joints"]
        self.motors = list(self.bus.motors)
        self.wheels = [motor for motor in self.motors if motor not in self.joints]
        self.speeds: list[int] = config["speeds"]
        self._check_joints(base=config["base"])
        self._lock = threading.Lock()
        self._target: list[float] | None = None
        self._twist = [0.0, 0.0, 0.0]
        self._pending = False
        self._moved_s = self._drove_s = -math.inf
        self._holding, self._stopped = True, False
        self._tries = _TRIES
        self._markers = itertools.cycle(range(10, 90, 4))
        self._values: list[float] = []

    # ------------------------------------------------------------ connect

    def connect(self) -> None:
        """Open the port and check the servos. The robot holds its position.

        Raises:
            RobotError: It cannot be used.
        """
        try:
            self.bus.connect(handshake=False)
            self.bus.port_handler.ser.exclusive = True
            self._extend_timeout()
        except _FAILED as error:
            raise RobotError(f"the port {self.port} cannot be opened; check the cable, and other programs") from error
        try:
            self._check_servos()
            self._check_calibration()
            self._prepare()
            self._limit_speed()
            self.retry(self.hold)
            self._tries = 1  # from now on the next period repeats what failed
        except _FAILED as error:
            sys.stderr.write(f"lerobot bridge: {error!r}\n")
            raise RobotError("the servos respond incompletely; check cables and power") from error

    def _check_joints(self, *, base: bool) -> None:
        names = [name.removesuffix(".pos") for name in self.robot.action_features if name.endswith(".pos")]
        if set(names) != set(self.joints):
            raise RobotError(f"the joints of the robot type must be: {', '.join(names)}")
        if ("x.vel" in self.robot.action_features) is not base:
            raise RobotError("the robot type and the robot must both have a base, or none")

    def _check_servos(self) -> None:
        missing = []
        for motor, servo in self.bus.motors.items():
            expected = self.bus.model_number_table[servo.model]
            for _ in range(_TRIES):
                model, result, _ = self.bus.packet_handler.ping(self.bus.port_handler, servo.id)
                if result == 0:
                    break
                self.bus.port_handler.ser.reset_input_buffer()
            if result != 0:
                missing.append(motor)
            elif model != expected:
                raise RobotError(f"the servo of {motor} is not a {servo.model}: model number {model}, not {expected}")
        if missing:
            raise RobotError(f"no response from the servos of: {', '.join(missing)}; check cables and power")

    def _check_calibration(self) -> None:
        path = self.robot.calibration_fpath
        wanted = self.bus.calibration
        if set(wanted) != set(self.motors):
            raise RobotError(f"no calibration of this robot in {path}; calibrate it with lerobot-calibrate")
        for register, field in (
            ("Homing_Offset", "homing_offset"),
            ("Min_Position_Limit", "range_min"),
            ("Max_Position_Limit", "range_max"),
        ):
            values = self.read(register, self.joints)
            wrong = [joint for joint in self.joints if values[joint] != getattr(wanted[joint], field)]
            if wrong:
                raise RobotError(
                    f"the servos of {', '.join(wrong)} have another calibration than {path}; run lerobot-calibrate"
                )

    def _prepare(self) -> None:
        """Configure servos without torque; their goal is their position. If some have it, that would drop the arm."""
        torque = self.read("Torque_Enable", self.motors)
        errors = self.read(self.registers["errors"], self.motors)
        if not any(torque.values()) and not any(errors.values()):
            present = self.read_positions()
            self.bus.sync_write("Goal_Position", present, normalize=False)
            self.retry(self.robot.configure)

    def _limit_speed(self) -> None:
        speeds = dict(zip(self.joints, self.speeds, strict=True))
        for _ in range(_TRIES):
            self.bus.sync_write(self.registers["speed"], speeds, normalize=False)
            if self.read(self.registers["speed"], self.joints) == speeds:
                return
        raise ValueError("the servos reject their speed")

    def description(self) -> dict[str, Any]:
        """Units and servos."""
        calibration = [self.bus.calibration[joint] for joint in self.joints]
        modes = [self.bus.motors[joint].norm_mode.value for joint in self.joints]
        return {
            "type": "ready",
            "range_ticks": [each.range_max - each.range_min for each in calibration],
            "percent": [mode == "range_0_100" for mode in modes],
            "motors": self.motors,
        }

    # ------------------------------------------------------------ commands, from any thread

    def accept(self, command: dict[str, Any]) -> None:
        """Note a command: ``values`` move the joints, ``twist`` moves the base until the next one."""
        if "hold" in command:
            self.stop()
        with self._lock:
            if self._stopped:
                return
            self._pending = True
            if "values" in command:
                self._target, self._holding, self._moved_s = command["values"], False, time.monotonic()
            else:
                self._twist, self._drove_s = command["twist"], time.monotonic()

    def stop(self) -> None:
        """Hold, and reject all later commands."""
        with self._lock:
            self._stopped = self._holding = True
            self._pending = False

    @property
    def holds(self) -> bool:
        """Whether a hold was confirmed by the servos."""
        return not self._holding and self._stopped

    # ------------------------------------------------------------ bus, from one thread

    def read(self, register: str, motors: list[str]) -> dict[str, int]:
        """Registers of several servos. Raises one of ``_FAILED``."""
        return dict(self.retry(lambda: self.bus.sync_read(register, motors, normalize=False)))

    def retry(self, call: Any) -> Any:
        """The result of a call, which may be repeated. Raises one of ``_FAILED`` if each attempt fails."""
        for _ in range(self._tries - 1):
            try:
                return call()
            except _LOST:
                with contextlib.suppress(ConnectionError):
                    self.resynchronize()
        return call()

    def resynchronize(self) -> None:
        """Discard late responses, which LeRobot would take for those of the next request: they name none.

        They arrive before that of a marker, a read of a length that nothing else has. Raises one of ``_FAILED``.
        """
        handler, port, servo = self.bus.packet_handler, self.bus.port_handler, self.bus.ids[0]
        port.is_using = False
        size = next(self._markers)
        handler.readTx(port, servo, 0, size)
        for _ in range(_TRIES):
            length, result = 0, 0
            while result == 0 and length != size:
                data, result, _ = handler.readRx(port, servo, size)
                length = len(data)
            if result == 0:
                return
            port.setPacketTimeout(size)
        raise ConnectionError("no response")

    def _extend_timeout(self) -> None:
        """Wait longer for a response than LeRobot: 34 to 50 ms are too short on a computer under load."""
        port = self.bus.port_handler
        set_timeout = port.setPacketTimeout

        def extended(length: int) -> None:
            set_timeout(length)
            port.packet_timeout += _LATE_MS

        port.setPacketTimeout = extended

    def read_positions(self) -> dict[str, int]:
        """Measured positions [ticks]. Raises one of ``_FAILED``, also for values that no encoder measures."""
        present = self.read("Present_Position", self.joints)
        if not all(-_TICKS <= value < 2 * _TICKS for value in present.values()):
            raise ValueError("a position that no encoder measures")
        return present

    def execute(self) -> None:
        """Send the newest command, or stop what is no longer commanded. Raises one of ``_FAILED``."""
        with self._lock:
            now_s = time.monotonic()
            if any(self._twist) and now_s - self._drove_s > WATCHDOG_S:
                self._twist, self._pending = [0.0, 0.0, 0.0], not self._stopped
            if self._target is not None and now_s - self._moved_s > WATCHDOG_S:
                self._target, self._holding = None, True
            holding, target, twist, pending = self._holding, self._target, self._twist, self._pending
            self._pending = False
        if holding:
            self._holding = not self.hold()  # only this thread sends: also a stop that came meanwhile is executed
        elif pending:
            self._send(target or self._values, twist)

    def hold(self) -> bool:
        """Keep goals near the measured position, which carry the load; others stop. Returns whether all did already."""
        present, goal = self.read_positions(), self.read("Goal_Position", self.joints)
        changed = {joint: now for joint, now in present.items() if abs(goal[joint] - now) > _LAG_TICKS}
        if changed:
            self.bus.sync_write("Goal_Position", changed, normalize=False)
        turning = bool(self.wheels) and any(self.read("Goal_Velocity", self.wheels).values())
        if turning:
            self.robot.stop_base()
        return not changed and not turning

    def measure(self) -> dict[str, Any]:
        """Joints, and the velocity of the base. Raises one of ``_FAILED``."""
        at_s = time.monotonic()
        observation = self.robot.get_observation()
        self._values = [float(observation[f"{joint}.pos"]) for joint in self.joints]
        twist = [float(observation.get(f"{name}.vel", 0.0)) for name in ("x", "y", "theta")]
        return {"type": "measurement", "at_s": at_s, "values": self._values, "twist": twist}

    def _send(self, values: list[float], twist: list[float]) -> None:
        action = {f"{joint}.pos": value for joint, value in zip(self.joints, values, strict=True)}
        if self.wheels:
            action.update(zip(("x.vel", "y.vel", "theta.vel"), twist, strict=True))
        self.robot.send_action(action)


class Bridge:
    """Reads commands and sends measurements."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._held = threading.Event()

    def run(self) -> None:
        """Run until the agent's side closes."""
        lines = self._link.makefile("rb")
        config = json.loads(lines.readline(_MAX_LINE))
        try:
            robot = Robot(config)
            robot.connect()
        except RobotError as error:
            self.send({"type": "failure", "message": str(error)})
            return
        self.send(robot.description())
        threading.Thread(target=self._work, args=(robot,), daemon=True).start()
        try:
            for line in iter(lambda: lines.readline(_MAX_LINE), b""):
                robot.accept(json.loads(line))
        except (OSError, ValueError, KeyError) as error:
            sys.stderr.write(f"lerobot bridge: {error!r}\n")
        robot.stop()
        self._held.wait(_END_S)

    def send(self, message: dict[str, Any]) -> None:
        """Send a message, unless the agent has gone: the main thread notices it too, and stops the robot."""
        with contextlib.suppress(OSError):
            self._link.sendall(json.dumps(message, allow_nan=False).encode() + b"\n")

    def _work(self, robot: Robot) -> None:
        """Use the bus. Ends the process if the port is gone."""
        status = StatusReader(robot)
        due_s = time.monotonic()
        while True:
            try:
                if status.results and not status.results[-1]:
                    robot.resynchronize()
                robot.execute()
                self.send(robot.measure())
                message = status.read()
                if message is not None:
                    self.send(message)
                status.results.append(True)
            except _LOST:
                status.results.append(False)
            except (OSError, termios.error):
                self.send({"type": "failure", "message": f"the port {robot.port} is gone; check the cable"})
                os._exit(1)
            if robot.holds:
                self._held.set()
            now_s = time.monotonic()
            due_s = max(due_s + _PERIOD_S, now_s)
            time.sleep(due_s - now_s)


class StatusReader:
    """Reads the servos' status, one register in each period. ``results``: whether each of the last ones succeeded."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._registers = {
            "errors": robot.registers["errors"],
            "torque": "Torque_Enable",
            "temperature": "Present_Temperature",
            "voltage": robot.registers["voltage"],
        }
        self._values: dict[str, list[int]] = {}
        self._at_s = 0.0
        self.results: collections.deque[bool] = collections.deque(maxlen=_HISTORY)

    def read(self) -> dict[str, Any] | None:
        """Read the next register; the complete status after the last one. Raises one of ``_FAILED``."""
        if not self._values:
            self._at_s = time.monotonic()
        name = next(name for name in self._registers if name not in self._values)
        values = self._robot.read(self._registers[name], self._robot.motors)
        self._values[name] = [values[motor] for motor in self._robot.motors]
        if len(self._values) < len(self._registers):
            return None
        complete, self._values = self._values, {}
        lost = self.results.count(False) / max(len(self.results), 1)
        return {"type": "status", "at_s": self._at_s, "lost": lost, **complete}


if __name__ == "__main__":
    for ending in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(ending, signal.SIG_IGN)  # it ends after the agent, when it has stopped the robot
    Bridge(socket.socket(fileno=os.dup(0))).run()
    os._exit(0)  # LeRobot's destructor must not use the bus
