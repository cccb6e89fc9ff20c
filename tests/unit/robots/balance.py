"""A robot on two legs on the bench: the agent's controller, its driver and the physics, stepped by hand."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from device_agent.drivers.mujoco import BipedDriver, World
from device_agent.drivers.mujoco.biped_driver import heading, upright
from device_agent.ports.driver import REST, Twist
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult, MotionGoal

STEP_S = 0.002
LONGEST_S = 30.0
FALLEN = 0.9
"""Cosine of the torso's tilt."""
START_RAD, SHAKE_RAD, PUSH_N = 0.02, 0.001, 1.0
"""How much each joint begins off; how much each motor shakes; how hard the torso is pushed about."""


class HandDriven(World):
    """A world without real time: ``step`` moves it, and nothing else."""

    def open(self) -> None:
        """Only what ``step`` needs."""
        self.build()

    def close(self) -> None:
        """There is nothing to stop."""


class Shaking:
    """``Process`` that disturbs a robot: motors that are never quite where they were told, and a push from nowhere.

    It steps after the robot's own process, so that the gait's targets shake as well. The push is on the torso's origin
    and changes every quarter of a second.
    """

    def __init__(self, body: int, actuators: npt.NDArray[Any], qpos: npt.NDArray[Any], seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._body, self._actuators, self._qpos = body, actuators, qpos
        self._begun = False
        self._off = np.zeros(len(actuators))
        self._push = np.zeros(3)
        self._groups = 0

    def step(self, model: Any, data: Any, time_s: float) -> None:
        """Disturb."""
        del time_s
        if not self._begun:
            self._begun = True
            data.qpos[self._qpos] += self._random.uniform(-START_RAD, START_RAD, len(self._qpos))
        limits = model.actuator_ctrlrange[self._actuators]
        if self._groups % 5 == 0:
            self._off = self._random.normal(0.0, SHAKE_RAD, len(self._actuators))
        if self._groups % 60 == 0:
            self._push = self._random.normal(0.0, PUSH_N, 3)
        data.ctrl[self._actuators] = np.clip(data.ctrl[self._actuators] + self._off, limits[:, 0], limits[:, 1])
        self._groups += 1
        data.qfrc_applied[:3] = self._push


class Walking:
    """A world driven by hand, and in it one robot that the agent's controller moves.

    Args:
        folder: Of the robot type.
        seed: Of what disturbs it; without one nothing does.
        scene: Another scene than the type's, in its folder.
    """

    def __init__(self, folder: Path, *, seed: int | None = None, scene: Path | None = None) -> None:
        self.type = robot_type.load(folder)
        self.world = HandDriven(scene or folder / self.type.scene, home=self.type.home_rad)
        self.driver = BipedDriver(robot_type=self.type, world=self.world, device="walker")
        self.driver.connect()
        self.model = self.world.model
        self.names = [joint.name for joint in self.type.joints]
        self.home = [self.type.home_rad[name] for name in self.names]
        self.body = self.model.body("torso").id
        self.actuators = np.array([self.model.actuator(name).id for name in self.names])
        self.qpos = np.array([self.model.joint(name).qposadr[0] for name in self.names])
        self.dof = np.array([self.model.joint(name).dofadr[0] for name in self.names])
        self.controller = Controller(self.type, LeaseGate())
        self.controller.start_at(self.home)
        self.tenure = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.period_s = self.type.period_ms / 1000
        self.now_s = 0.0
        self.least_upright = 1.0
        self.applied: tuple[float, ...] = tuple(self.home)
        self.twist = REST
        self.world.step(1)
        if seed is not None:
            self.world.add(Shaking(self.body, self.actuators, self.qpos, seed))

    def period(self) -> None:
        """One control period: what the loop does, then the physics."""
        self.now_s += self.period_s
        self.driver.observe()
        tick = self.controller.update(self.now_s)
        self.applied = self.driver.send(tick.position_rad)
        self.controller.record_applied(self.applied)
        self.twist = self.driver.drive(tick.twist)
        self.world.step(round(self.period_s / STEP_S))
        self.least_upright = min(self.least_upright, self.upright)

    def wait(self, duration_s: float) -> None:
        """Let it be [s]."""
        for _ in range(round(duration_s / self.period_s)):
            self.period()

    def move(self, position_rad: Mapping[str, float], *, speed: float = 0.3) -> None:
        """As an action does, to its end."""
        self.follow(self.controller.start_joint_goal(self.tenure, position_rad, speed=speed))

    def drive(self, twist: Twist, *, duration_s: float) -> None:
        """As an action does, to its end."""
        self.follow(self.controller.start_drive(self.tenure, twist, duration_s=duration_s))

    def follow(self, course: MotionGoal) -> None:
        """Wait for its end."""
        end_s = self.now_s + LONGEST_S
        while not course.finished.is_set():
            self.period()
            assert self.now_s < end_s, "did not arrive"
        assert course.result is GoalResult.REACHED, course.why

    @property
    def torso_m(self) -> npt.NDArray[Any]:
        """Where it really is, shape (3,)."""
        return np.array(self.world.snapshot().body_position_m[self.body])

    @property
    def heading_rad(self) -> float:
        """Where it really looks."""
        return heading(self.world.snapshot().body_quaternion[self.body])

    @property
    def upright(self) -> float:
        """Cosine of its torso's tilt."""
        return upright(self.world.snapshot().body_quaternion[self.body])

    @property
    def soles_m(self) -> npt.NDArray[Any]:
        """Height of both soles [m]."""
        sites = [self.model.site(name).id for name in ("LLeg", "RLeg")]
        return np.array(self.world.snapshot().site_position_m[sites][:, 2])


class WalkedRobot:
    """The script's ``robot`` where that goes on two legs: the controller moves it, and it must not fall.

    Attributes:
        joints: As scripts know them; ``can``: calls besides those that every robot has.
        moves: How often it moved.
        touched: Pairs of its own bodies that came to touch.
        fastest: The highest share of a joint's velocity limit.
    """

    def __init__(self, folder: Path) -> None:
        self._walking = Walking(folder)
        self.joints = tuple(self._walking.names)
        self.can = ("say",)
        self.moves = 0
        self.touched: set[tuple[str, str]] = set()
        self.fastest = 0.0
        self._limits = np.array([joint.max_velocity_rad_s for joint in self._walking.type.joints])

    def move_joints(self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5) -> None:
        if not isinstance(position_rad, Mapping):
            position_rad = dict(zip(self.joints, position_rad, strict=True))
        walking = self._walking
        self._follow(walking.controller.start_joint_goal(walking.tenure, position_rad, speed=speed))

    def home(self, speed: float = 0.5) -> None:
        self.move_joints(self._walking.type.home_rad, speed=speed)

    def posture(self, name: str, speed: float = 0.5) -> None:
        self.move_joints(self._walking.type.postures[name], speed=speed)

    def look(self, position_m: Sequence[float], speed: float = 0.5) -> None:
        assert len(position_m) == 3
        gaze = self._walking.type.gaze
        assert gaze is not None
        self.move_joints(dict.fromkeys(gaze.joints, 0.0), speed=speed)

    def say(self, text: str, language: str = "") -> None:
        assert text
        assert len(language) <= 5

    def drive(
        self, forward_m_s: float = 0.0, left_m_s: float = 0.0, turn_rad_s: float = 0.0, *, duration_s: float = 1.0
    ) -> None:
        walking, twist = self._walking, Twist(forward_m_s, left_m_s, turn_rad_s)
        self._follow(walking.controller.start_drive(walking.tenure, twist, duration_s=duration_s))

    def wait(self, seconds: float) -> None:
        assert seconds >= 0
        for _ in range(math.ceil(seconds / self._walking.period_s)):
            self._period()

    def progress(self, share: float) -> None:
        assert 0 <= share <= 1

    @property
    def warned(self) -> bool:
        """Whether MuJoCo had something to warn of."""
        return bool(self._walking.world._data.warning.number.any())

    def _follow(self, course: MotionGoal) -> None:
        while not course.finished.is_set():
            self._period()
        assert course.result is GoalResult.REACHED, course.why
        self.moves += 1

    def _period(self) -> None:
        walking = self._walking
        walking.period()
        assert walking.upright > FALLEN, "it fell"
        model, data = walking.model, walking.world._data
        roots = {int(model.body_rootid[walking.body])}
        for contact in data.contact[: data.ncon]:
            bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
            if {int(model.body_rootid[body]) for body in bodies} == roots:
                first, second = sorted(model.body(body).name for body in bodies)
                self.touched.add((first, second))
        moved = np.abs([walking.world.snapshot().qvel[walking.dof]]) / self._limits
        self.fastest = max(self.fastest, float(moved.max()))
