"""A robot for tests: the process that emulates its servo bus, and its calibration file."""

import json
import math
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROOT
from tests.harness.robots.lerobot.dynamixel import XL330, XL430

TICKS = 4096
"""Ticks of a turn."""
CENTER = 2048
WHEELS = ("base_left_wheel", "base_back_wheel", "base_right_wheel")
WHEEL_RADIUS_M, BASE_RADIUS_M = 0.05, 0.125
WHEEL_ANGLES_RAD = np.radians(np.array([150.0, -90.0, 30.0]))
"""Directions in which the wheels of a LeKiwi roll; left, back, right."""
MODELS = {"koch_follower": (XL430, XL430, XL330, XL330, XL330, XL330)}
"""Model number of each servo, where they differ."""


class ServoPeer:
    """The robot; it is at home, and its servos have torque with an old goal, or none.

    Args:
        robot_type: Joints and limits; the last joint is the gripper.
        robot: LeRobot's name of the robot.
        python: Interpreter that has LeRobot.
        folder: Folder of the port and the calibration.
        torque: Whether the servos have torque at the start.
    """

    def __init__(self, robot_type: RobotType, robot: str, python: Path, folder: Path, *, torque: bool = False) -> None:
        self._robot = robot
        self._python = python
        self._joints = robot_type.joints
        self._folder = folder
        self._lock = threading.Lock()
        self.ids = {joint.name: index for index, joint in enumerate(self._joints, 1)}
        home = {name: self.ticks(name, robot_type.home_rad[name]) for name in self.ids}
        self.servos = {
            str(index): self._registers(index - 1, name, home[name], torque=torque) for name, index in self.ids.items()
        }
        if robot_type.base is not None:
            wheel = {"Max_Position_Limit": TICKS - 1, "Operating_Mode": 1, "Torque_Enable": int(torque)}
            names = enumerate(WHEELS, len(self.ids) + 1)
            self.servos |= {str(index): {**wheel, **self._sensors()} for index, _ in names}
        self._write_calibration()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.harness.robots.lerobot.bus"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._exchange({"protocol": self.protocol, "port": str(self.port), "servos": self.servos})

    @property
    def protocol(self) -> str:
        """Family of the servos."""
        return "dynamixel" if self._robot == "koch_follower" else "feetech"

    @property
    def port(self) -> Path:
        """Path of the serial port."""
        return self._folder / "port"

    def options(self) -> dict[str, str]:
        """Options of a driver for this robot."""
        return {
            "robot": self._robot,
            "port": str(self.port),
            "id": "arm",
            "calibration": str(self._folder),
            "python": str(self._python),
        }

    def range(self, name: str) -> tuple[int, int]:
        """Calibrated range of a joint [ticks], centered for all but the gripper."""
        joint = self._joints[self.ids[name] - 1]
        half = math.ceil(max(-joint.lower_rad, joint.upper_rad) * TICKS / math.tau)
        if name.endswith("gripper"):
            return CENTER, CENTER + math.ceil((joint.upper_rad - joint.lower_rad) * TICKS / math.tau)
        return CENTER - half, CENTER + half

    def ticks(self, name: str, position_rad: float) -> int:
        """Position of a joint on its encoder [ticks]."""
        zero_rad = self._joints[self.ids[name] - 1].lower_rad if name.endswith("gripper") else 0.0
        return round(CENTER + (position_rad - zero_rad) * TICKS / math.tau)

    def state(self, **request: Any) -> dict[str, dict[str, Any]]:
        """All servos by name, after an optional request; ``set`` names servos too."""
        names = self._names()
        if "set" in request:
            request["set"] = {names[name]: values for name, values in request["set"].items()}
        state = self._exchange(request)
        return {name: state[index] for name, index in names.items()}

    def joint_positions(self) -> tuple[float, ...]:
        """See ``Peer``."""
        state = self.state()
        zeros = [joint.lower_rad if joint.name.endswith("gripper") else 0.0 for joint in self._joints]
        ticks = [state[joint.name]["position"] - CENTER for joint in self._joints]
        return tuple(zero + value * math.tau / TICKS for zero, value in zip(zeros, ticks, strict=True))

    def joint_velocities(self) -> tuple[float, ...]:
        """See ``Peer``."""
        state = self.state()
        return tuple(state[joint.name]["velocity"] * math.tau / TICKS for joint in self._joints)

    def base_twist(self) -> Twist:
        """See ``Peer``."""
        state = self.state()
        if WHEELS[0] not in state:
            return Twist()
        rolling_m_s = np.array([state[name]["velocity"] for name in WHEELS]) * math.tau / TICKS * WHEEL_RADIUS_M
        columns = [np.cos(WHEEL_ANGLES_RAD), np.sin(WHEEL_ANGLES_RAD), np.full(3, BASE_RADIUS_M)]
        return Twist(*np.linalg.solve(np.stack(columns, axis=1), rolling_m_s).tolist())

    def disturb(self, disturbance: Disturbance | str) -> None:
        """See ``Peer``; ``checksum``: wrong checksums."""
        self._exchange({"disturb": disturbance if isinstance(disturbance, str) else disturbance.value})

    def restore(self) -> None:
        """See ``Peer``."""
        self._exchange({"restore": True})

    def close(self) -> None:
        """Unplug the bus."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.kill()
        self.process.wait()

    def _names(self) -> dict[str, str]:
        names = [*self.ids, *(WHEELS if len(self.servos) > len(self.ids) else ())]
        return dict(zip(names, self.servos, strict=True))

    def _registers(self, index: int, name: str, position: int, *, torque: bool) -> dict[str, int]:
        lower, upper = self.range(name)
        model = {"Model_Number": MODELS[self._robot][index]} if self._robot in MODELS else {}
        return {
            **model,
            **self._sensors(),
            "Min_Position_Limit": lower,
            "Max_Position_Limit": upper,
            "Present_Position": position,
            # An old goal, which a servo would move to when it gets torque.
            "Goal_Position": position if torque else lower + 1,
            "Torque_Enable": int(torque),
        }

    def _sensors(self) -> dict[str, int]:
        voltage = "Present_Input_Voltage" if self.protocol == "dynamixel" else "Present_Voltage"
        return {voltage: 121, "Present_Temperature": 31}

    def _write_calibration(self) -> None:
        ranges = {name: self.range(name) for name in self.ids}
        if len(self.servos) > len(self.ids):
            ranges |= dict.fromkeys(WHEELS, (0, TICKS - 1))
        calibration = {
            name: {"id": index, "drive_mode": 0, "homing_offset": 0, "range_min": lower, "range_max": upper}
            for index, (name, (lower, upper)) in enumerate(ranges.items(), 1)
        }
        (self._folder / "arm.json").write_text(json.dumps(calibration))

    def _exchange(self, request: Any) -> Any:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with self._lock:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())
