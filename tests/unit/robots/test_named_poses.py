"""Shipped postures, expressions, behaviours and visemes are within the agent's limits."""

from pathlib import Path

import pytest

from device_agent import geometry
from device_agent.protocol.manifests import robot_type
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult, MotionGoal
from device_agent.runtime.planning import named_poses
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.runtime.planning.visemes import estimate_duration_s
from tests.unit.robots.folders import FOLDERS

LONGEST_S = 120.0
TEXT = "How very quickly the brown fox jumps over a lazy dog!"


def kinds(*parts: str) -> list[Path]:
    """Folders of types whose manifest has one of these parts."""
    types = ((folder, robot_type.load(folder)) for folder in FOLDERS)
    return [folder for folder, kind in types if any(getattr(kind, part) for part in parts)]


class PoseRunner:
    """Steps a type's controller, including collision checks."""

    def __init__(self, folder: Path) -> None:
        self.kind = robot_type.load(folder)
        self.controller = Controller(self.kind, LeaseGate(), geometry=geometry.load(self.kind, folder))
        self.controller.start_at([self.kind.home_rad[joint.name] for joint in self.kind.joints])
        self.reservation = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.now_s = 0.0

    def move(self, position_rad: dict[str, float], label: str) -> None:
        self.follow(
            self.controller.start_joint_goal(self.reservation, position_rad, speed=named_poses.EXPRESSION_SPEED), label
        )

    def go(self, trajectory: BehaviourTrajectory, label: str) -> None:
        self.follow(self.controller.start_trajectory(self.reservation, trajectory.trajectory()), label)

    def follow(self, goal: MotionGoal, label: str) -> None:
        until_s = self.now_s + LONGEST_S
        while not goal.finished.is_set() and self.now_s < until_s:
            self.now_s += self.kind.period_ms / 1000
            self.controller.update(self.now_s)
        assert goal.result is GoalResult.REACHED, f"{label}: {goal.why and goal.why.message}"


@pytest.mark.parametrize("folder", kinds("postures", "expressions"), ids=lambda folder: folder.name)
def test_every_transition_between_named_poses_succeeds(folder: Path) -> None:
    runner = PoseRunner(folder)
    for name in runner.kind.postures:
        runner.move(named_poses.posture(runner.kind, name), name)
    runner.move(runner.kind.home_rad, "home")
    for name in runner.kind.expressions:
        runner.move(named_poses.expression(runner.kind, name, 1.0), name)


@pytest.mark.parametrize("folder", kinds("behaviours"), ids=lambda folder: folder.name)
def test_every_behaviour_is_played_from_home(folder: Path) -> None:
    runner = PoseRunner(folder)
    for name, keyframes in runner.kind.behaviours.items():
        trajectory = BehaviourTrajectory(runner.kind, runner.controller.commanded_rad)
        trajectory.add_keyframes(keyframes, {frame.say: estimate_duration_s(frame.say) for frame in keyframes})
        runner.go(trajectory, name)
        runner.move(runner.kind.home_rad, f"home after {name}")


@pytest.mark.parametrize("folder", kinds("visemes"), ids=lambda folder: folder.name)
def test_every_viseme_is_reached(folder: Path) -> None:
    runner = PoseRunner(folder)
    trajectory = BehaviourTrajectory(runner.kind, runner.controller.commanded_rad)
    trajectory.add_speech(SpokenLine(0.0, TEXT, estimate_duration_s(TEXT)))
    jaws = [place for place in trajectory.trajectory().position_rad.T if place.max() - place.min() > 0.05]
    assert jaws, "the jaw does not move"
    runner.go(trajectory, TEXT)
