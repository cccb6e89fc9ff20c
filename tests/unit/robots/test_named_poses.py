"""Shipped postures, expressions, behaviours and visemes are within the agent's limits."""

from pathlib import Path

import pytest

from device_agent.protocol.manifests import robot_type
from device_agent.runtime.planning import named_poses
from device_agent.runtime.planning.behaviour_trajectory import BehaviourTrajectory, SpokenLine
from device_agent.runtime.planning.visemes import estimate_duration_s
from tests.unit.robots.folders import FOLDERS
from tests.unit.robots.simulated_robot import ControlledRobot

pytestmark = pytest.mark.slow
TEXT = "How very quickly the brown fox jumps over a lazy dog!"


def types_with(*parts: str) -> pytest.MarkDecorator:
    """Parametrize by the types whose manifest has one of these parts."""
    types = ((folder, robot_type.load(folder)) for folder in FOLDERS)
    folders = [folder for folder, kind in types if any(getattr(kind, part) for part in parts)]
    return pytest.mark.parametrize("folder", folders, ids=lambda folder: folder.name)


@types_with("postures", "expressions")
def test_every_transition_between_named_poses_succeeds(folder: Path) -> None:
    robot = ControlledRobot(folder)
    for name in robot.type.postures:
        robot.move(named_poses.posture(robot.type, name), speed=named_poses.EXPRESSION_SPEED)
    robot.move(robot.type.home_rad)
    for name in robot.type.expressions:
        robot.move(named_poses.expression(robot.type, name, 1.0), speed=named_poses.EXPRESSION_SPEED)


@types_with("behaviours")
def test_every_behaviour_is_played_from_home(folder: Path) -> None:
    robot = ControlledRobot(folder)
    for keyframes in robot.type.behaviours.values():
        trajectory = BehaviourTrajectory(robot.type, robot.controller.commanded_rad)
        trajectory.add_keyframes(keyframes, {frame.say: estimate_duration_s(frame.say) for frame in keyframes})
        robot.follow(robot.controller.start_trajectory(robot.reservation, trajectory.trajectory()))
        robot.move(robot.type.home_rad)


@types_with("visemes")
def test_every_viseme_is_reached_without_collision(folder: Path) -> None:
    robot = ControlledRobot(folder)
    assert robot.shape is not None
    for pose in robot.type.visemes.values():
        position_rad = robot.type.home_rad | pose
        assert robot.shape.clearance([position_rad[name] for name in robot.names]).excess_m >= 0
    trajectory = BehaviourTrajectory(robot.type, robot.controller.commanded_rad)
    trajectory.add_speech(SpokenLine(0.0, TEXT, estimate_duration_s(TEXT)))
    path = trajectory.trajectory()
    assert max(joint.max() - joint.min() for joint in path.position_rad.T) > 0.05, "the jaw does not move"
    robot.follow(robot.controller.start_trajectory(robot.reservation, path))
