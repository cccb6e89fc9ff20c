"""Cameras of simulated robots."""

import msgspec
import numpy as np
import pytest
import simplejpeg

from device_agent.drivers import mujoco as simulation
from device_agent.ports.driver import DriverError, HasCameras
from device_agent.protocol import Stream
from device_agent.protocol.manifests import robot_type
from device_agent.simulation import renderer
from tests.harness.network.brokers import PATIENCE_S
from tests.harness.paths import ROOT

pytestmark = pytest.mark.slow
QBO = ROOT / "robots" / "qbo"
TYPE = robot_type.load(QBO)


def test_a_robot_camera_shows_its_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer, "TIMEOUT_S", PATIENCE_S)
    driver = simulation.create(TYPE, QBO, {}, "qbo")
    assert isinstance(driver, HasCameras)
    assert driver.frame("eyes") is None
    driver.connect()
    try:
        taken = driver.frame("eyes")
        assert taken is not None
        pixels = simplejpeg.decode_jpeg(taken.content)
        assert pixels.shape == (taken.height, taken.width, 3)
        assert float(np.std(pixels)) > 5, "uniform image"
        with pytest.raises(DriverError, match="no camera 'ears'; available cameras: eyes"):
            driver.frame("ears")
    finally:
        driver.close()
        driver.close()
    assert driver.frame("eyes") is None


def test_a_missing_camera_is_an_error() -> None:
    kind = msgspec.structs.replace(TYPE, cameras=(Stream(name="third", rate_hz=1.0),))
    with pytest.raises(DriverError, match="no camera 'third'"):
        simulation.create(kind, QBO, {}, "qbo").connect()
