"""Every movement, under the control of the agent's own limits: what ships is not held before anything."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device_agent import geometry
from device_agent.ports.driver import Twist
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.errors import Refused
from device_agent.runtime.planning import gaze, named_poses
from tests.harness.paths import ROBOTS
from tests.unit.robots.folders import MOVEMENTS, heard, whereabouts

LONGEST_S = 60.0


class LimitedRobot:
    """The script's ``robot``: the controller moves it, tick by tick, with its shape known."""

    def __init__(self, folder: Path) -> None:
        self.type = robot_type.load(folder)
        self.shape = geometry.load(self.type, folder)
        self.controller = Controller(self.type, LeaseGate(), geometry=self.shape)
        self.position = [self.type.home_rad[joint.name] for joint in self.type.joints]
        self.controller.start_at(self.position)
        self.tenure = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.joints = tuple(joint.name for joint in self.type.joints)
        self.can = ("say",)
        self.now_s = 0.0
        self.place = (0.0, 0.0, 0.0)  # x, y [m] and yaw [rad] of an ideal base
        self.tightest_m = 1.0
        self.limited: set[str] = set()

    def move_joints(self, position_rad: Mapping[str, float] | Sequence[float], speed: float = 0.5) -> None:
        if not isinstance(position_rad, Mapping):
            position_rad = dict(zip(self.joints, position_rad, strict=True))
        self.follow(self.controller.start_joint_goal(self.tenure, position_rad, speed=speed))

    def drive(
        self, forward_m_s: float = 0.0, left_m_s: float = 0.0, turn_rad_s: float = 0.0, *, duration_s: float = 1.0
    ) -> None:
        twist = Twist(forward_m_s, left_m_s, turn_rad_s)
        self.follow(self.controller.start_drive(self.tenure, twist, duration_s=duration_s))

    def go_to(self, x_m: float, y_m: float, yaw_rad: float | None = None) -> None:
        """Straight there: ``test_errands.py`` goes around things."""
        towards = math.atan2(y_m - self.place[1], x_m - self.place[0])
        self._turn(towards - self.place[2])
        self.drive(forward_m_s=0.2, duration_s=math.dist(self.place[:2], (x_m, y_m)) / 0.2)
        self._turn(0.0 if yaw_rad is None else yaw_rad - towards)

    def _turn(self, angle_rad: float) -> None:
        angle_rad = math.remainder(angle_rad, 2 * math.pi)
        self.drive(turn_rad_s=math.copysign(0.5, angle_rad), duration_s=abs(angle_rad) / 0.5)

    def look(self, position_m: tuple[float, float, float], speed: float = 0.5) -> None:
        assert self.shape is not None
        self.move_joints(gaze.solve_gaze(self.type, self.shape, self.position, position_m), speed=speed)

    def express(self, name: str, strength: float = 1.0) -> None:
        self.move_joints(named_poses.expression(self.type, name, strength), speed=named_poses.EXPRESSION_SPEED)

    def say(self, text: str, language: str = "") -> None:
        assert text
        assert len(language) <= 5

    def follow(self, move: MotionGoal) -> None:
        end_s = self.now_s + LONGEST_S
        while not move.finished.is_set():
            self.now_s += self.type.period_ms / 1000
            tick = self.controller.update(self.now_s)
            self.position = tick.position_rad
            self.go(tick.twist)
            assert self.now_s < end_s, "did not arrive"
            if self.shape is not None and round(self.now_s * 1000) % 40 == 0:
                self.tightest_m = min(self.tightest_m, self.shape.clearance(self.position).room_m)
        self.limited |= set(move.limited)
        if move.result is not GoalResult.REACHED:
            raise move.why or AssertionError("no reason")

    def go(self, twist: Twist) -> None:
        (x_m, y_m, yaw_rad), period_s = self.place, self.type.period_ms / 1000
        x_m += (twist.forward_m_s * math.cos(yaw_rad) - twist.left_m_s * math.sin(yaw_rad)) * period_s
        y_m += (twist.forward_m_s * math.sin(yaw_rad) + twist.left_m_s * math.cos(yaw_rad)) * period_s
        self.place = (x_m, y_m, yaw_rad + twist.turn_rad_s * period_s)

    def latest(self, device: str, stream: str) -> dict[str, Any]:
        """The script's ``room.latest``."""
        assert (device, stream) == ("perception", "positions")
        return whereabouts(self.type, *self.place)

    def home(self, speed: float = 0.5) -> None:
        self.move_joints(self.type.home_rad, speed=speed)

    def posture(self, name: str, speed: float = 0.5) -> None:
        self.move_joints(self.type.postures[name], speed=speed)

    def state(self) -> dict[str, Any]:
        return {
            "position_rad": dict(zip(self.joints, self.position, strict=True)),
            "streams": heard(self.type, self.place[2]),
        }


def play(path: Path, parameters: dict[str, Any]) -> LimitedRobot:
    robot = LimitedRobot(path.parent.parent)
    given = {
        "robot": robot,
        "room": robot,
        "wait": lambda _: None,
        "parameters": parameters,
        "progress": lambda _: None,
        "RobotError": AssertionError,
        "print": lambda *_: None,
        "__name__": "__movement__",
    }
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), given)  # noqa: S102 - our own scripts
    return robot


@pytest.mark.parametrize("path", MOVEMENTS, ids=lambda path: f"{path.parent.parent.name}-{path.stem}")
def test_no_shipped_movement_is_limited(path: Path) -> None:
    robot = play(path, {})
    assert robot.limited == set()
    assert robot.tightest_m >= 0


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("slow_square", {"side_m": 9, "height_m": 0, "speed": 1.0}),
        ("pick_and_place", {"times": 1, "speed": 1.0}),
        ("wave", {"times": 1, "speed": 1.0}),
    ],
)
def test_no_movement_is_limited_with_extreme_parameters(name: str, parameters: dict[str, Any]) -> None:
    assert play(ROBOTS / "ur5" / "movements" / f"{name}.py", parameters).limited == set()


def test_collisions_are_prevented() -> None:
    robot = LimitedRobot(ROBOTS / "ur5")
    with pytest.raises(Refused, match="no room there: workspace: wrist_3 \u2013 lower z, 281 mm too near"):
        robot.move_joints({"shoulder_lift": -0.2, "elbow": 1.2}, speed=1.0)
    with pytest.raises(Refused, match="no room there: clearance: table_top \u2013 wrist_3_link"):
        robot.move_joints({"shoulder_lift": -0.86}, speed=1.0)
    for target in through_itself(robot):
        with pytest.raises(Refused, match="something is in the way: clearance: ") as refused:
            robot.move_joints(target, speed=1.0)
        assert refused.value.code == "no_room"
        assert robot.shape is not None
        assert robot.shape.clearance(robot.position).room_m >= 0
        robot.home(speed=1.0)


def through_itself(robot: LimitedRobot) -> list[list[float]]:
    """Positions with room around them, to which the straight way leads through the arm itself."""
    assert robot.shape is not None
    random = np.random.default_rng(11)
    home = list(robot.position)
    found: list[list[float]] = []
    while len(found) < 5:
        turns = random.uniform(-3, 3, len(home)).tolist()
        target = [
            min(max(place + turn, joint.lower_rad), joint.upper_rad)
            for place, turn, joint in zip(home, turns, robot.type.joints, strict=True)
        ]
        if robot.shape.clearance(target).room_m > 0:
            swept = robot.shape.sweep([home, target])
            if swept.clearance is not None:
                found.append(target)
    return found
