"""Robots moved by the agent's controller without real time: with the controller only, and with driver and physics."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent import geometry
from device_agent.drivers.mujoco import World, _driver_class
from device_agent.drivers.mujoco.biped_driver import heading, upright
from device_agent.ports.driver import REST, MobileDriver, Twist
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult, MotionGoal

STEP_S = 0.002
LONGEST_S = 120.0
START_RAD, SHAKE_RAD, PUSH_N = 0.02, 0.001, 1.0
"""Disturbances: error of each joint at the start, noise of each motor, force on the torso."""


class ControlledRobot:
    """A robot type's controller, stepped period by period.

    Attributes:
        shape: Its geometry for collision checks; None without them.
    """

    def __init__(self, folder: Path, *, collisions: bool = True) -> None:
        self.type = robot_type.load(folder)
        self.names = [joint.name for joint in self.type.joints]
        self.home_rad = [self.type.home_rad[name] for name in self.names]
        self.shape = geometry.load(self.type, folder) if collisions else None
        self.controller = Controller(self.type, LeaseGate(), geometry=self.shape)
        self.controller.start_at(self.home_rad)
        self.reservation = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.period_s = self.type.period_ms / 1000
        self.now_s = 0.0

    def run_period(self) -> None:
        """One control period."""
        self.now_s += self.period_s
        self.controller.update(self.now_s)

    def wait(self, seconds: float) -> None:
        for _ in range(math.ceil(seconds / self.period_s - 1e-9)):
            self.run_period()

    def move(self, position_rad: Mapping[str, float], *, speed: float = 0.3) -> None:
        """Move the joints and wait for arrival."""
        self.follow(self.controller.start_joint_goal(self.reservation, position_rad, speed=speed))

    def follow(self, goal: MotionGoal) -> None:
        """Wait for the end of a goal.

        Raises:
            Refused: The goal was interrupted.
        """
        end_s = self.now_s + LONGEST_S
        while not goal.finished.is_set():
            self.run_period()
            assert self.now_s < end_s, "did not arrive"
        if goal.result is not GoalResult.REACHED:
            raise goal.why or AssertionError("interrupted without a reason")


class Disturbance:
    """``Process`` with motor noise and a force on the torso that changes every quarter of a second.

    It steps after the robot's own process, so that it also disturbs the gait's targets.
    """

    def __init__(self, actuators: npt.NDArray[Any], qpos: npt.NDArray[Any], seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._actuators, self._qpos = actuators, qpos
        self._noise = np.zeros(len(actuators))
        self._push = np.zeros(3)
        self._groups = 0

    def step(self, model: Any, data: Any, time_s: float) -> None:
        del time_s
        if self._groups == 0:
            data.qpos[self._qpos] += self._random.uniform(-START_RAD, START_RAD, len(self._qpos))
        limits = model.actuator_ctrlrange[self._actuators]
        if self._groups % 5 == 0:
            self._noise = self._random.normal(0.0, SHAKE_RAD, len(self._actuators))
        if self._groups % 60 == 0:
            self._push = self._random.normal(0.0, PUSH_N, 3)
        data.ctrl[self._actuators] = np.clip(data.ctrl[self._actuators] + self._noise, limits[:, 0], limits[:, 1])
        self._groups += 1
        data.qfrc_applied[:3] = self._push


class SimulatedRobot(ControlledRobot):
    """A robot in its scene or a room, moved by controller and driver.

    Args:
        folder: Folder of the robot type.
        seed: Seed of a ``Disturbance``; None for none.
        collisions: Whether the controller checks for collisions.
        room: World of the room that contains the robot under its type's name; None for its own scene.
    """

    def __init__(
        self, folder: Path, *, seed: int | None = None, collisions: bool = False, room: World | None = None
    ) -> None:
        super().__init__(folder, collisions=collisions)
        self.world = room or World(folder / self.type.scene, home=self.type.home_rad)
        self.world.build()
        self.model = self.world.model
        self.driver: Any = _driver_class(self.type)(
            robot_type=self.type, world=self.world, device=self.type.type, prefix=f"{self.type.type}/" if room else ""
        )
        self.driver._resolve(self.model)  # in place of ``connect``, which would start real time
        self.driver._connected = True
        self.body = self.driver._base
        self.least_upright = 1.0
        self.applied_rad: tuple[float, ...] = tuple(self.home_rad)
        self.twist = REST
        self.world.step(1)
        if seed is not None:
            self.world.add(Disturbance(self.driver._actuators, self.driver._qpos, seed))

    def run_period(self) -> None:
        """One period of the control loop, then the physics."""
        self.now_s += self.period_s
        self.driver.observe()
        tick = self.controller.update(self.now_s)
        self.applied_rad = self.driver.send(tick.position_rad)
        self.controller.record_applied(self.applied_rad)
        if isinstance(self.driver, MobileDriver):
            self.twist = self.driver.drive(tick.twist)
        self.world.step(round(self.period_s / STEP_S))
        self.least_upright = min(self.least_upright, self.upright)

    def drive(self, twist: Twist, *, duration_s: float) -> None:
        """Drive the base and wait for the end."""
        self.follow(self.controller.start_drive(self.reservation, twist, duration_s=duration_s))

    @property
    def position_m(self) -> npt.NDArray[Any]:
        """True position of the base, shape (3,)."""
        return np.array(self.world.snapshot().body_position_m[self.body])

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and yaw [rad] of the base."""
        return *self.position_m[:2].tolist(), heading(self.world.snapshot().body_quaternion[self.body])

    @property
    def upright(self) -> float:
        """Cosine of the base's tilt."""
        return upright(self.world.snapshot().body_quaternion[self.body])
