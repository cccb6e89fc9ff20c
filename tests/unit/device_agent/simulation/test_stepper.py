"""Batched steps equal single steps."""

import copy

import mujoco
import numpy as np
import pytest

from device_agent.simulation.stepper import Stepper
from tests.harness.agent.rooms import ManualWorld


@pytest.mark.slow
def test_batched_steps_equal_single_steps() -> None:
    lab = ManualWorld()
    lab.advance(0.5)
    model = lab.model
    one = mujoco.MjData(model)
    lab.copy(one)
    many = copy.copy(one)
    stepper, rng = Stepper(model), np.random.default_rng(5)
    for count in (1, 2, 4, 2, 4, 1, 4):
        rows = one.ctrl + rng.normal(0.0, 0.02, (count, model.nu))
        push = rng.normal(0.0, 0.5, (model.nbody, 6))  # external forces stay in effect
        one.xfrc_applied[:], many.xfrc_applied[:] = push, push
        one.mocap_pos[:] += 0.01
        many.mocap_pos[:] += 0.01
        for row in rows:
            one.ctrl[:] = row
            mujoco.mj_step(model, one)
        stepper.step(many, rows)
        for name in ("time", "qpos", "qvel", "act", "ctrl", "qacc_warmstart", "xfrc_applied", "mocap_pos", "eq_active"):
            assert np.array_equal(getattr(one, name), getattr(many, name)), name
    assert not np.array_equal(one.qpos, model.qpos0)
