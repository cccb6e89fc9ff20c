"""The UR5 with a gripper: the arm of the type ``ur5``, and a gripper with published measures."""

import msgspec
import numpy as np
import pytest

from device_agent.protocol.manifests import robot_type
from tests.harness.paths import ROBOTS, UR5
from tests.unit.robots.folders import SteppedRobot

FOLDER = ROBOTS / "ur5_gripper"
STROKE_M, FORCE_N, MASS_KG, SPEED_M_S = 0.085, (20.0, 235.0), 0.925, (0.02, 0.15)
"""Robotiq, *2F-85 instruction manual*, mechanical specifications."""


def test_the_arm_is_that_of_the_type_ur5() -> None:
    arm, tool = SteppedRobot(UR5), SteppedRobot(FOLDER)
    assert tool.names == arm.names
    for index in range(1, arm.model.nbody):
        name = arm.model.body(index).name
        ours, theirs = tool.model.body(name), arm.model.body(index)
        for field in ("mass", "inertia", "pos", "quat", "ipos", "iquat"):
            assert getattr(ours, field) == pytest.approx(getattr(theirs, field)), (name, field)
        assert tool.model.body_gravcomp[ours.id] == arm.model.body_gravcomp[theirs.id]
        for each in range(theirs.geomnum[0]):
            first, second = tool.model.geom(ours.geomadr[0] + each), arm.model.geom(theirs.geomadr[0] + each)
            for field in ("type", "size", "pos", "quat", "contype", "group"):
                assert getattr(first, field) == pytest.approx(getattr(second, field)), (name, field)
    for name in arm.names:
        first, second = tool.model.joint(name), arm.model.joint(name)
        for field in ("range", "armature", "damping", "axis"):
            assert getattr(first, field) == pytest.approx(getattr(second, field)), (name, field)
        assert tool.model.jnt_actfrcrange[first.id] == pytest.approx(arm.model.jnt_actfrcrange[second.id])
        for field in ("gainprm", "biasprm", "forcerange", "ctrlrange"):
            assert getattr(tool.model.actuator(name), field) == pytest.approx(getattr(arm.model.actuator(name), field))


def test_the_manifest_differs_from_that_of_the_arm_in_the_gripper_only() -> None:
    arm, tool = (msgspec.to_builtins(robot_type.load(folder)) for folder in (UR5, FOLDER))
    changed = {name for name in arm if arm[name] != tool[name]}
    assert changed == {
        "type",
        "label",
        "description",
        "model",
        "margin_m",
        "frames",
        "workspace",
        "streams",
        "simulation",
    }


def test_stroke_force_mass_and_speed_are_published() -> None:
    robot = SteppedRobot(FOLDER)
    gripper = robot.model.actuator("gripper")
    assert gripper.ctrlrange.tolist() == [0, STROKE_M]
    assert FORCE_N[0] <= gripper.forcerange[1] <= FORCE_N[1]
    bodies = ("gripper", "finger_1", "finger_2")
    assert sum(float(robot.model.body(name).mass[0]) for name in bodies) == pytest.approx(MASS_KG)
    assert robot.type.simulation is not None
    assert robot.type.simulation.gripper is not None
    assert SPEED_M_S[0] <= robot.type.simulation.gripper.speed_m_s <= SPEED_M_S[1]


def test_the_fingers_move_together_and_do_not_touch_each_other() -> None:
    robot = SteppedRobot(FOLDER)
    for stroke_m in (0.085, 0.03, 0.0):
        robot.data.actuator("gripper").ctrl[0] = stroke_m
        robot.step(1500)
        fingers = [float(robot.data.joint(name).qpos[0]) for name in ("finger_1", "finger_2")]
        assert fingers == pytest.approx([stroke_m / 2, stroke_m / 2], abs=5e-4)
        own = {robot.model.body(name).id for name in ("finger_1", "finger_2")}
        pairs = robot.model.geom_bodyid[robot.data.contact.geom[: robot.data.ncon]]
        assert not np.isin(pairs, list(own)).any()
