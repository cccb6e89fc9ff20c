"""A whole device: Qbo's driver in real time, its scripts in the sandbox, its sonars' readings on the way to both."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent import geometry
from device_agent.drivers import load
from device_agent.drivers.mujoco import WheeledDriver
from device_agent.protocol import AckStatus, Measurements, topics
from device_agent.protocol.manifests import robot_type
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.paths import ROBOTS

FOLDER = ROBOTS / "qbo"
QBO = robot_type.load(FOLDER)


@pytest.fixture
def harness(tmp_path: Path) -> Iterator[DeviceHarness]:
    driver = load("mujoco")(QBO, FOLDER, {}, "qbo")
    assert isinstance(driver, WheeledDriver)
    harness = DeviceHarness(tmp_path, kind=QBO, driver=driver, geometry=geometry.load(QBO, FOLDER))  # type: ignore[arg-type]
    harness.device.start()
    yield harness
    harness.stop()


def test_it_comes_forward_until_its_sonars_say_near(harness: DeviceHarness) -> None:
    source = (FOLDER / "movements" / "come_near.py").read_text(encoding="utf-8")
    eventually(lambda: harness.heard(topics.TELE, Measurements, "sonar"))
    ack = harness.end(
        harness.command(harness.script("parameters = {'near_m': 1.65, 'speed_m_s': 0.2}\n" + source), epoch=1)
    )
    assert ack.status is AckStatus.DONE, ack.reason
    assert ack.output.startswith("stopped 1.")
    sonar = harness.heard(topics.TELE, Measurements, "sonar")
    nearest_m = min(float(told.values["distance_m.left"]) for told in sonar)
    assert 1.4 < nearest_m <= 1.65
    odometry = harness.heard(topics.TELE, Measurements, "odometry")
    farthest_m = max(float(told.values["x_m"]) for told in odometry)
    assert farthest_m == pytest.approx(2.0 - 0.156 - nearest_m, abs=0.06)
    assert float(odometry[-1].values["x_m"]) < farthest_m, "it went back a little"
    assert math.isclose(float(odometry[-1].values["y_m"]), 0.0, abs_tol=0.01)
    assert harness.heard(topics.TELE, Measurements, "health")
