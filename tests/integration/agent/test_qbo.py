"""Qbo with its driver in real time, a script in the sandbox, and sonar measurements for both."""

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


def test_qbo_approaches_until_its_sonars_measure_an_obstacle(harness: DeviceHarness) -> None:
    source = (FOLDER / "movements" / "come_near.py").read_text(encoding="utf-8")
    eventually(lambda: harness.published(topics.TELE, Measurements, "sonar"))
    script = harness.script("parameters = {'near_m': 1.65, 'speed_m_s': 0.2}\n" + source)
    ack = harness.end(harness.command(script, epoch=1))
    assert ack.status is AckStatus.DONE, ack.reason
    assert ack.output.startswith("stopped 1.")
    sonar = harness.published(topics.TELE, Measurements, "sonar")
    nearest_m = min(float(measured.values["distance_m.left"]) for measured in sonar)
    assert 1.4 < nearest_m <= 1.65
    odometry = [measured.values for measured in harness.published(topics.TELE, Measurements, "odometry")]
    furthest_m = max(float(values["x_m"]) for values in odometry)
    assert furthest_m == pytest.approx(2.0 - 0.156 - nearest_m, abs=0.06)
    assert float(odometry[-1]["x_m"]) < furthest_m, "Qbo moved back"
    assert float(odometry[-1]["y_m"]) == pytest.approx(0.0, abs=0.01)
    assert harness.published(topics.TELE, Measurements, "health")
