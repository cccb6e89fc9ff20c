"""Stiffness of simulated servos."""

from typing import Any

import numpy as np
import pytest

from device_agent.drivers.mujoco import MujocoDriver, World
from device_agent.ports.skills import SkillError
from device_agent.protocol import Say, SetStiffness
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import UR5

KIND = robot_type.load(UR5)
CONTEXT: Any = None


@pytest.fixture
def world() -> World:
    world = World(UR5 / KIND.scene, home=KIND.home_rad)
    world.build()
    return world


@pytest.fixture
def driver(world: World) -> MujocoDriver:
    driver = MujocoDriver(robot_type=KIND, world=world, device="arm")
    driver._resolve(world.model)
    return driver


def test_a_compliant_joint_falls_and_the_others_hold(world: World, driver: MujocoDriver) -> None:
    before = world.step(100).position_rad
    driver.perform(SetStiffness(value=0.0, joints=("wrist_1",)), CONTEXT)
    after = world.step(500).position_rad
    assert abs(after["wrist_1"] - before["wrist_1"]) > 0.3
    assert abs(after["shoulder_pan"] - before["shoulder_pan"]) < 0.02
    assert abs(after["elbow"] - before["elbow"]) < 0.1


def test_full_stiffness_restores_the_model(world: World, driver: MujocoDriver) -> None:
    model = world.model
    fields = ("actuator_gainprm", "actuator_biasprm", "body_gravcomp")
    original = {name: getattr(model, name).copy() for name in fields}
    driver.perform(SetStiffness(value=0.3, joints=()), CONTEXT)
    world.step(4)
    elbow = model.actuator("elbow").id
    assert model.actuator_gainprm[elbow, 0] == pytest.approx(original["actuator_gainprm"][elbow, 0] * 0.3)
    driver.perform(SetStiffness(value=1.0, joints=()), CONTEXT)
    world.step(4)
    assert all(np.array_equal(getattr(model, name), original[name]) for name in fields)


def test_other_skills_are_rejected(driver: MujocoDriver) -> None:
    with pytest.raises(SkillError, match="does not support this skill"):
        driver.perform(Say(text="hello"), CONTEXT)
