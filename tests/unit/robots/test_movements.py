"""Every movement runs in its robot's scene: within the limits, without contacts, and limited by no safety check."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device_agent.ports.driver import Twist
from device_agent.runtime.control.goals import MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze, named_poses
from tests.harness.paths import ROBOTS, UR5
from tests.unit.robots.folders import MOVEMENTS, contacts
from tests.unit.robots.simulated_robot import ControlledRobot, SimulatedRobot

pytestmark = pytest.mark.slow
UPRIGHT = 0.9
"""Cosine of the base's tilt."""


class RobotError(Exception):
    """The error that scripts may catch."""


class ScriptedRobot(SimulatedRobot):
    """The script's ``robot`` and ``room``.

    Attributes:
        moves: Number of motions.
        limited: Limits that changed a motion.
        touched: Pairs of bodies that touched but did not at the start.
        fastest: Highest share of a joint's velocity limit.
        tightest_m: Smallest clearance.
    """

    def __init__(self, folder: Path, *, collisions: bool = True) -> None:
        super().__init__(folder, collisions=collisions)
        self.joints = tuple(self.names)
        self.can = ("say",)
        self.moves = 0
        self.limited: set[str] = set()
        self.touched: set[tuple[str, str]] = set()
        self.fastest = 0.0
        self.tightest_m = 1.0
        self._walks = self.type.simulation is not None and self.type.simulation.walk is not None
        self._initial_contacts = contacts(self.model, self.world._data)
        self._velocity_limits = np.array([joint.max_velocity_rad_s for joint in self.type.joints])

    def move_joints(self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5) -> None:
        if not isinstance(position_rad, Mapping):
            position_rad = dict(zip(self.joints, position_rad, strict=True))
        self.move(position_rad, speed=speed)
        if not self._walks:  # the gait moves a walking robot's legs
            self.wait(0.3)
            error_rad = np.subtract(self.driver.observe().position_rad, self.controller.commanded_rad)
            assert np.abs(error_rad).max() < 0.005, "did not arrive"

    def set_control(self, name: str, value: float) -> float:
        return float(self.driver.set_control(name, value, self))

    def home(self, speed: float = 0.5) -> None:
        self.move_joints(self.type.home_rad, speed)

    def posture(self, name: str, speed: float = 0.5) -> None:
        self.move_joints(self.type.postures[name], speed)

    def express(self, name: str, strength: float = 1.0) -> None:
        self.move_joints(named_poses.expression(self.type, name, strength), named_poses.EXPRESSION_SPEED)

    def look(self, position_m: tuple[float, float, float], speed: float = 0.5) -> None:
        assert self.shape is not None
        self.move_joints(gaze.solve_gaze(self.type, self.shape, self.controller.commanded_rad, position_m), speed)

    def say(self, text: str, language: str = "") -> None:
        assert text
        assert len(language) <= 5

    def drive(  # type: ignore[override]
        self, forward_m_s: float = 0.0, left_m_s: float = 0.0, turn_rad_s: float = 0.0, *, duration_s: float = 1.0
    ) -> None:
        super().drive(Twist(forward_m_s, left_m_s, turn_rad_s), duration_s=duration_s)

    def go_to(self, x_m: float, y_m: float, yaw_rad: float | None = None) -> None:
        """Drives straight; ``test_navigation.py`` covers obstacles."""
        x, y, yaw = self.pose
        towards = math.atan2(y_m - y, x_m - x)
        self._turn(towards - yaw)
        self.drive(forward_m_s=0.2, duration_s=math.dist((x, y), (x_m, y_m)) / 0.2)
        self._turn(0.0 if yaw_rad is None else yaw_rad - towards)

    def _turn(self, angle_rad: float) -> None:
        angle_rad = math.remainder(angle_rad, 2 * math.pi)
        self.drive(turn_rad_s=math.copysign(0.5, angle_rad), duration_s=abs(angle_rad) / 0.5)

    def state(self) -> dict[str, Any]:
        """Joint positions, and measurements in an empty hall."""
        measured = {"sonar": {"distance_m.left": 4.0, "distance_m.right": 4.0}, "odometry": {"yaw_rad": self.pose[2]}}
        streams = [stream.name for stream in self.type.streams if stream.name in measured]
        return {
            "position_rad": dict(zip(self.joints, self.driver.observe().position_rad, strict=True)),
            "streams": {name: {"values": measured[name], "age_s": 0.0} for name in streams},
        }

    def latest(self, device: str, stream: str) -> dict[str, Any]:
        """Room data with the robot at its position and a person in front of it."""
        assert (device, stream) == ("perception", "positions")
        name, (x_m, y_m, yaw_rad) = self.type.type, self.pose
        values = {"age_s.person": 0.1, "x_m.person": 1.9, "y_m.person": 0.35}
        values |= {f"age_s.{name}": 0.1, f"x_m.{name}": x_m, f"y_m.{name}": y_m, f"yaw_rad.{name}": yaw_rad}
        return {"values": values, "age_s": 0.1}

    def progress(self, share: float) -> None:
        assert 0 <= share <= 1

    def follow(self, goal: MotionGoal) -> None:
        super().follow(goal)
        # A walking robot's driver applies the gait's leg positions.
        self.limited |= {limit for limit in goal.limited if not limit.endswith(": driver")}
        self.moves += 1

    def run_period(self) -> None:
        super().run_period()
        assert self.upright > UPRIGHT, "it fell"
        self.touched |= contacts(self.model, self.world._data, only=self.body if self._walks else None)
        self.touched -= self._initial_contacts
        velocity = np.abs(self.world.snapshot().qvel[self.driver._dof]) / self._velocity_limits
        self.fastest = max(self.fastest, float(velocity.max()))
        if self.shape is not None and round(self.now_s * 1000) % 40 == 0:
            self.tightest_m = min(self.tightest_m, self.shape.clearance(self.controller.commanded_rad).excess_m)


GRASPS = {
    *(ROBOTS / "ur5_gripper" / "movements" / f"{name}.py" for name in ("pick_and_place", "insert_peg", "open_drawer")),
    ROBOTS / "nao" / "movements" / "hold_stick.py",
}
"""Touch objects on purpose; ``cli/trials`` runs them."""
EXTREMES: list[tuple[str, dict[str, Any]]] = [
    ("slow_square", {"side_m": 9, "height_m": 0, "speed": 1.0}),
    ("slow_square", {"side_m": 9, "height_m": 9}),
    ("inspect_table", {"stops": 9, "pause_s": 0, "speed": 1.0}),
    ("wave", {"times": 1, "speed": 1.0}),
    ("pick_and_place", {"times": 1, "speed": 1.0}),
]


@pytest.mark.parametrize(
    ("path", "parameters"),
    [pytest.param(path, {}, id=f"{path.parent.parent.name}-{path.stem}") for path in MOVEMENTS if path not in GRASPS]
    + [(UR5 / "movements" / f"{name}.py", parameters) for name, parameters in EXTREMES],
)
def test_movement_stays_inside_the_limits_without_contacts(path: Path, parameters: dict[str, Any]) -> None:
    robot = ScriptedRobot(path.parent.parent)
    script = {
        "robot": robot,
        "room": robot,
        "wait": robot.wait,
        "parameters": parameters,
        "progress": robot.progress,
        "RobotError": RobotError,
        "print": lambda *_: None,
        "__name__": "__movement__",
    }
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), script)  # noqa: S102 - our own scripts
    assert robot.moves > 0
    assert robot.limited == set()
    assert robot.tightest_m >= 0
    assert robot.touched == set()
    assert robot.fastest <= 1.02
    assert not robot.world._data.warning.number.any()


def test_a_movement_into_the_table_is_detected() -> None:
    robot = ScriptedRobot(UR5, collisions=False)
    with pytest.raises((AssertionError, Refused)):
        robot.move_joints({"shoulder_lift": -0.2, "elbow": 1.2}, speed=0.3)
    assert robot.touched


def test_collisions_are_prevented() -> None:
    robot = ControlledRobot(UR5)
    assert robot.shape is not None
    with pytest.raises(
        Refused, match="no clearance at the target: workspace: wrist_3 \u2013 lower z, 281 mm too close"
    ):
        robot.move({"shoulder_lift": -0.2, "elbow": 1.2}, speed=1.0)
    with pytest.raises(Refused, match="no clearance at the target: clearance: table_top \u2013 wrist_3_link"):
        robot.move({"shoulder_lift": -0.86}, speed=1.0)
    random = np.random.default_rng(11)
    lower, upper = ([getattr(joint, name) for joint in robot.type.joints] for name in ("lower_rad", "upper_rad"))
    blocked = 0
    while blocked < 5:  # targets with clearance, to which the straight path leads through the arm itself
        target = np.clip(robot.home_rad + random.uniform(-3, 3, len(robot.names)), lower, upper).tolist()
        if robot.shape.clearance(target).excess_m <= 0 or robot.shape.sweep([robot.home_rad, target]).clearance is None:
            continue
        blocked += 1
        with pytest.raises(Refused, match="an obstacle is in the way: clearance: ") as refused:
            robot.move(dict(zip(robot.names, target, strict=True)), speed=1.0)
        assert refused.value.code == "no_room"
        assert robot.shape.clearance(robot.controller.commanded_rad).excess_m >= 0
        robot.move(robot.type.home_rad, speed=1.0)
