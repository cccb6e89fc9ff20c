"""Stiffness of simulated servos."""

import mujoco
import numpy as np
import pytest

from device_agent.drivers.mujoco import MujocoDriver, World
from device_agent.ports.skills import SkillError, Stage
from device_agent.protocol import Say, SetStiffness
from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROOT

ROBOT = ROOT / "robots" / "ur5"
KIND = robot_type.load(ROBOT)
STAGE: Stage = None  # type: ignore[assignment]


class Arm:
    """A manually stepped arm."""

    def __init__(self) -> None:
        self.world = World(ROBOT / KIND.scene, home=KIND.home_rad)
        self.world.build()
        self.driver = MujocoDriver(robot_type=KIND, world=self.world, device="arm")
        self.driver._resolve(self.world.model)
        self.names = [joint.name for joint in KIND.joints]

    def stiffen(self, value: float, *joints: str) -> None:
        self.driver.perform(SetStiffness(value=value, joints=joints), STAGE)

    def run(self, seconds: float) -> dict[str, float]:
        snapshot = self.world.step(round(seconds / 0.002))
        return dict(zip(self.names, snapshot.qpos[self.driver._qpos].tolist(), strict=True))


def test_a_compliant_joint_falls_and_the_others_hold() -> None:
    arm = Arm()
    before = arm.run(0.2)
    arm.stiffen(0.0, "wrist_1")
    after = arm.run(1.0)
    assert abs(after["wrist_1"] - before["wrist_1"]) > 0.3
    assert abs(after["shoulder_pan"] - before["shoulder_pan"]) < 0.02
    assert abs(after["elbow"] - before["elbow"]) < 0.1


def test_full_stiffness_restores_the_model() -> None:
    arm = Arm()
    model = arm.world.model
    made = [model.actuator_gainprm.copy(), model.actuator_biasprm.copy(), model.body_gravcomp.copy()]
    arm.stiffen(0.3)
    arm.run(0.1)
    assert not np.array_equal(made[0], model.actuator_gainprm)
    elbow = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, "elbow")
    assert model.actuator_gainprm[elbow, 0] == pytest.approx(made[0][elbow, 0] * 0.3)
    arm.stiffen(1.0)
    arm.run(0.1)
    now = [model.actuator_gainprm, model.actuator_biasprm, model.body_gravcomp]
    assert all(np.array_equal(one, other) for one, other in zip(made, now, strict=True))


def test_other_skills_are_rejected() -> None:
    with pytest.raises(SkillError, match="does not support this skill"):
        Arm().driver.perform(Say(text="hello"), STAGE)
