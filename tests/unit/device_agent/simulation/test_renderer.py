"""Culling does not change images."""

import mujoco
import numpy as np
import pytest

from device_agent.simulation import renderer
from tests.harness.agent.rooms import StillWorld

SIZE = (160, 120)
CAMERAS = ("camera", "depth", "depth_ceiling", "pan_tilt", "nao/CameraTop")


@pytest.fixture(scope="module")
def lab() -> StillWorld:
    return StillWorld()


def drawn(
    lab: StillWorld, camera: str, monkeypatch: pytest.MonkeyPatch, *, depth: bool
) -> tuple[renderer.RenderedImage, ...]:
    """An image with culling, and one without."""
    wish = (mujoco.mj_name2id(lab.model, mujoco.mjtObj.mjOBJ_CAMERA, camera), SIZE[0], SIZE[1])
    seen = renderer.Renderer(lab)
    seen.open()
    try:
        quick = seen.render(wish[0], width=wish[1], height=wish[2], depth=depth)
        monkeypatch.setattr(renderer, "_in_view", lambda model, *_: np.ones(model.ngeom, dtype=np.bool_))
        return quick, seen.render(wish[0], width=wish[1], height=wish[2], depth=depth)
    finally:
        seen.close()


@pytest.mark.parametrize("camera", CAMERAS)
def test_culling_does_not_change_depth_images(lab: StillWorld, camera: str, monkeypatch: pytest.MonkeyPatch) -> None:
    quick, whole = drawn(lab, camera, monkeypatch, depth=True)
    # Geoms below a pixel may be missing: less than 1 % of 19,200 pixels.
    assert np.mean(np.abs(quick.pixels - whole.pixels) > 0.01) < 0.01


@pytest.mark.parametrize("camera", CAMERAS)
def test_culling_hides_geoms(lab: StillWorld, camera: str) -> None:
    data = mujoco.MjData(lab.model)
    lab.copy(data)
    index = mujoco.mj_name2id(lab.model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    seen = renderer._in_view(lab.model, data, index, *SIZE)
    assert 0 < seen.sum() < lab.model.ngeom
    assert seen[lab.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE].all()


def test_culling_does_not_change_colour_images(lab: StillWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    quick, whole = drawn(lab, "camera", monkeypatch, depth=False)
    assert np.mean(np.abs(quick.pixels.astype(int) - whole.pixels) > 2) < 0.01
