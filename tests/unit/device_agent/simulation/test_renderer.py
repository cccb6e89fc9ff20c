"""Culling does not change images."""

import mujoco
import numpy as np
import pytest

from device_agent.simulation import renderer
from tests.harness.agent.rooms import ManualWorld

pytestmark = pytest.mark.slow
SIZE = (160, 120)


@pytest.fixture(scope="module")
def lab() -> ManualWorld:
    return ManualWorld()


@pytest.mark.parametrize("camera", ["camera", "depth", "depth_ceiling", "pan_tilt", "nao/CameraTop"])
def test_culling_hides_geoms_and_does_not_change_images(
    lab: ManualWorld, camera: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(renderer, "TIMEOUT_S", 60.0)
    index = mujoco.mj_name2id(lab.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    data = mujoco.MjData(lab.model)
    lab.copy(data)
    visible = renderer._in_view(lab.model, data, index, *SIZE)
    assert 0 < visible.sum() < lab.model.ngeom
    assert visible[lab.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE].all()
    width, height = SIZE
    drawn = renderer.Renderer(lab)
    drawn.open()
    try:
        culled = [drawn.render(index, width=width, height=height, depth=depth).pixels for depth in (True, False)]
        monkeypatch.setattr(renderer, "_in_view", lambda model, *_: np.ones(model.ngeom, dtype=np.bool_))
        whole = [drawn.render(index, width=width, height=height, depth=depth).pixels for depth in (True, False)]
    finally:
        drawn.close()
    # Geoms below a pixel may be missing: less than 1 % of 19,200 pixels.
    assert np.mean(np.abs(culled[0] - whole[0]) > 0.01) < 0.01
    assert np.mean(np.abs(culled[1].astype(int) - whole[1]) > 2) < 0.01
