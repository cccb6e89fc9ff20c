"""Faults injected into a simulated robot appear in its diagnostics through measurements and states."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from device_agent.drivers import load
from device_agent.drivers.mujoco import MujocoDriver
from device_agent.drivers.mujoco.fault_injection import FaultInjector
from device_agent.drivers.mujoco.motor_model import MotorModel
from device_agent.protocol import AckStatus, Measurements, Mode, MoveJoints, State, codec, topics
from device_agent.protocol.manifests import robot_type
from function_app.entrypoints.ingest.router import ingest, ingest_telemetry
from tests.fakes.agent import Robot
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.cloud.cloud import Cloud, Person
from tests.harness.paths import ROBOTS
from tests.unit.function_app.services.health.test_diagnostics import MINUTE, field, open_faults

pytestmark = pytest.mark.slow

Pair = tuple[Person, Robot]

UR5 = robot_type.load(ROBOTS / "ur5")
NAMES = [joint.name for joint in UR5.joints]
WORK = np.array([10.0, 45.0, 40.0, 5.0, 4.0, 1.0])
"""Mean joint torques of an arm at work [N m]."""


class SimulatedWear:
    """Ingests the measurements of an arm's motor model every ten seconds of simulated time."""

    def __init__(self, cloud: Cloud, robot: Robot, faults: Path) -> None:
        self.cloud = cloud
        self.health = MotorModel(UR5.joints, None, seed="arm")
        self.injector = FaultInjector(faults, NAMES)
        self.topic = topics.device(robot.space, robot.id, robot.names[0], topics.TELE, "health")
        self.now_ms = cloud.clock.now_ms()
        self.windows = 0

    def messages(self, windows: int) -> Iterable[tuple[str, bytes]]:
        for _ in range(windows):
            faults = self.injector.poll()
            if faults is not None:
                self.health.inject(faults)
            for second in range(10):
                self.health.observe(self.windows * 10.0 + second, WORK, np.zeros(6))
            self.cloud.clock.advance(10)
            self.now_ms += 10_000
            self.windows += 1
            values = dict(self.health.values())
            message = Measurements(tick_ms=self.now_ms, at_ms=self.now_ms, sequence=self.windows, values=values)
            yield self.topic, codec.encode(message)

    def live(self, minutes: int) -> None:
        self.cloud.run(ingest_telemetry(self.cloud.functions, list(self.messages(minutes * MINUTE))))


def test_an_overheating_joint_raises_a_trend_fault_before_its_limit(cloud: Cloud, pair: Pair, tmp_path: Path) -> None:
    anna, robot = pair
    faults = tmp_path / "arm.toml"
    arm = SimulatedWear(cloud, robot, faults)
    arm.live(60)  # warm up
    anna = cloud.sign_in("anna")
    assert open_faults(anna, robot) == []
    faults.write_text("overheating = { elbow = 0.2 }")
    for _ in range(40):
        arm.live(1)
        anna = cloud.sign_in("anna")
        if open_faults(anna, robot):
            break
    (fault,) = open_faults(anna, robot)
    assert (fault["code"], fault["kind"], fault["limit"]) == ("health.temperature_c.elbow", "trend", 80.0)
    assert fault["value"] < 70, "the trend is reported before the warning limit"
    shown = field(anna, robot, "temperature_c.elbow")
    assert shown["limit_latest_s"] is None or 300 < shown["limit_earliest_s"] < shown["limit_latest_s"]
    faults.unlink()
    arm.live(60)
    anna = cloud.sign_in("anna")
    assert open_faults(anna, robot) == []


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[DeviceHarness]:
    driver = load("mujoco")(UR5, ROBOTS / "ur5", {"faults": str(tmp_path / "arm.toml")}, "arm")
    assert isinstance(driver, MujocoDriver)
    harness = DeviceHarness(tmp_path, kind=UR5, driver=driver)  # type: ignore[arg-type]  # not a fake driver
    harness.device.start()
    harness.device.link_changed(True)
    yield harness
    harness.stop()


def test_a_stuck_joint_raises_a_fault_in_state_and_cloud(
    cloud: Cloud, pair: Pair, arm: DeviceHarness, tmp_path: Path
) -> None:
    anna, robot = pair
    eventually(lambda: arm.published(topics.TELE, Measurements, "health"))
    (tmp_path / "arm.toml").write_text('stuck = ["elbow"]')
    eventually(lambda: arm.driver._fault_injector.version != (0, 0))  # type: ignore[attr-defined]
    elbow_rad = UR5.home_rad["elbow"]
    ack = arm.end(arm.command(MoveJoints(position_rad={"elbow": elbow_rad - 0.5}, speed=0.05), epoch=1))
    assert ack.status is AckStatus.FAILED
    assert ack.reason is not None
    assert ack.reason.message.startswith("elbow does not move at full motor effort")
    state: State = eventually(lambda: [state for state in arm.published(topics.STATE, State) if state.faults])[0]
    assert state.mode is Mode.FAULT
    cloud.run(ingest(cloud.functions, robot.topic(topics.STATE), codec.encode(state)))
    (fault,) = open_faults(anna, robot)
    assert fault["message"].startswith("elbow does not move")
    # It holds its position and can move again after the fault is removed.
    eventually(lambda: arm.published(topics.STATE, State)[-1].mode is not Mode.FAULT)
    (tmp_path / "arm.toml").unlink()
    eventually(lambda: arm.driver._fault_injector.version == (0, 0))  # type: ignore[attr-defined]
    ack = arm.end(arm.command(MoveJoints(position_rad={"elbow": elbow_rad - 0.2}, speed=0.5), epoch=2))
    assert ack.status is AckStatus.DONE
