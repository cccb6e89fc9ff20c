"""Dependent joints are computed as the physics moves them."""

import mujoco
import numpy as np
import pytest

from device_agent.simulation.mjcf.equality_joints import EqualityJoints

HAND = """
<mujoco><compiler angle="radian"/>
<default><geom size=".01" mass=".01" contype="0"/><joint armature=".01" damping=".1"/></default>
<worldbody>
  <body><joint name="a" axis="0 0 1" range="-1 1"/><geom/></body>
  <body><joint name="b" axis="0 0 1" ref="0.3"/><geom/></body>
  <body><joint name="twice_a" axis="0 0 1" ref="0.1"/><geom/></body>
  <body><joint name="chained" type="slide" axis="1 0 0"/><geom/></body>
  <body><joint name="mixed" axis="0 1 0"/><geom/></body>
  <body><joint name="free_one" axis="0 1 0"/><geom/></body>
</worldbody>
<tendon>
  <fixed name="mix"><joint joint="mixed" coef="2"/><joint joint="a" coef="-1"/><joint joint="b" coef="0.5"/></fixed>
</tendon>
<equality>
  <joint joint1="chained" joint2="twice_a" polycoef="0.2 0.05 0 0 0"/>
  <joint joint1="a" joint2="twice_a" polycoef="-0.05 0.5 0 0 0"/>
  <tendon tendon1="mix" polycoef="0.1 0 0 0 0"/>
</equality>
<actuator><position name="a" joint="a" kp="5" kv="0.5"/><position name="b" joint="b" kp="5" kv="0.5"/></actuator>
</mujoco>
"""


def test_dependent_joints_match_the_physics():
    model = mujoco.MjModel.from_xml_string(HAND)
    model.opt.gravity[:] = 0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    random = np.random.default_rng(3)
    for _ in range(5):
        data.ctrl[:] = random.uniform(-0.8, 0.8, model.nu)
        mujoco.mj_step(model, data, nstep=4000)
        settled = data.qpos.copy()
        settled[[2, 3, 4]] = 9.0
        EqualityJoints(model).apply(settled)
        assert settled == pytest.approx(data.qpos, abs=2e-3)


def test_factors_refer_to_independent_joints():
    model = mujoco.MjModel.from_xml_string(HAND)
    equality_joints = EqualityJoints(model)
    assert [model.joint(tie.joint).name for tie in equality_joints.all] == ["twice_a", "chained", "mixed"]
    assert equality_joints.factors_of(model.joint("chained").id) == pytest.approx({model.joint("a").id: 0.1})
    assert equality_joints.factors_of(model.joint("mixed").id) == pytest.approx(
        {model.joint("a").id: 0.5, model.joint("b").id: -0.25}
    )
    assert equality_joints.factors_of(model.joint("free_one").id) == {}
    assert equality_joints.offset(model.joint("free_one").id) == 0.0


def test_circular_inactive_and_missing_constraints_are_ignored():
    ring = '<joint joint1="free_one" joint2="mixed"/><joint joint1="mixed" joint2="free_one"/></equality>'
    inactive = HAND.replace('<tendon tendon1="mix"', '<tendon active="false" tendon1="mix"')
    model = mujoco.MjModel.from_xml_string(inactive.replace("</equality>", ring))
    assert [model.joint(joint.joint).name for joint in EqualityJoints(model).all] == ["twice_a", "chained"]
    single = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    qpos = np.array([0.7])
    EqualityJoints(mujoco.MjModel.from_xml_string(single)).apply(qpos)
    assert qpos.tolist() == [0.7]
