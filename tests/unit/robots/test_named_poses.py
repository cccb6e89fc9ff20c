"""What ships can be shown: every posture, expression and behaviour, under the agent's own limits."""

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
    """The folders of types whose manifest has any of these."""
    found = ((folder, robot_type.load(folder)) for folder in FOLDERS)
    return [folder for folder, kind in found if any(getattr(kind, part) for part in parts)]


class Shower:
    """A type's controller, tick by tick, with its shape known."""

    def __init__(self, folder: Path) -> None:
        self.kind = robot_type.load(folder)
        self.controller = Controller(self.kind, LeaseGate(), geometry=geometry.load(self.kind, folder))
        self.controller.start_at([self.kind.home_rad[joint.name] for joint in self.kind.joints])
        self.tenure = self.controller.reserve(epoch=1, on_revoked=lambda _: None)
        self.now_s = 0.0

    def move(self, position_rad: dict[str, float], what: str) -> None:
        self.follow(
            self.controller.start_joint_goal(self.tenure, position_rad, speed=named_poses.EXPRESSION_SPEED), what
        )

    def go(self, score: BehaviourTrajectory, what: str) -> None:
        self.follow(self.controller.start_trajectory(self.tenure, score.trajectory()), what)

    def follow(self, course: MotionGoal, what: str) -> None:
        until_s = self.now_s + LONGEST_S
        while not course.finished.is_set() and self.now_s < until_s:
            self.now_s += self.kind.period_ms / 1000
            self.controller.update(self.now_s)
        assert course.result is GoalResult.REACHED, f"{what}: {course.why and course.why.message}"


@pytest.mark.parametrize("folder", kinds("postures", "expressions"), ids=lambda folder: folder.name)
def test_every_transition_between_named_poses_succeeds(folder: Path) -> None:
    shower = Shower(folder)
    for name in shower.kind.postures:
        shower.move(named_poses.posture(shower.kind, name), name)
    shower.move(shower.kind.home_rad, "home")
    for name in shower.kind.expressions:
        shower.move(named_poses.expression(shower.kind, name, 1.0), name)


@pytest.mark.parametrize("folder", kinds("behaviours"), ids=lambda folder: folder.name)
def test_every_behaviour_is_played_from_home(folder: Path) -> None:
    shower = Shower(folder)
    for name, keyframes in shower.kind.behaviours.items():
        score = BehaviourTrajectory(shower.kind, shower.controller.commanded_rad)
        score.add_keyframes(keyframes, {frame.say: estimate_duration_s(frame.say) for frame in keyframes})
        shower.go(score, name)
        shower.move(shower.kind.home_rad, f"home after {name}")


@pytest.mark.parametrize("folder", kinds("visemes"), ids=lambda folder: folder.name)
def test_every_viseme_is_reached(folder: Path) -> None:
    shower = Shower(folder)
    score = BehaviourTrajectory(shower.kind, shower.controller.commanded_rad)
    score.add_speech(SpokenLine(0.0, TEXT, estimate_duration_s(TEXT)))
    jaws = [place for place in score.trajectory().position_rad.T if place.max() - place.min() > 0.05]
    assert jaws, "the jaw does not move"
    shower.go(score, TEXT)
