"""Motor temperature, load, battery, and injected faults."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from device_agent.drivers import load
from device_agent.drivers.mujoco import MujocoDriver
from device_agent.drivers.mujoco.fault_injection import NO_FAULTS, FaultInjector, InjectedFaults, read
from device_agent.drivers.mujoco.motor_model import (
    AMBIENT_C,
    FULL_RISE_C,
    IDLE_RISE_C,
    PLUGGED_IN_PERCENT,
    WARMING_S,
    MotorModel,
)
from device_agent.ports.driver import DriverError
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.capabilities import Battery
from tests.harness.paths import ROBOTS

WITHIN_S = 60.0
UR5 = robot_type.load(ROBOTS / "ur5")
NAMES = [joint.name for joint in UR5.joints]
MOST = np.array([joint.max_effort_nm for joint in UR5.joints])
STILL = np.zeros(6)
BATTERY = Battery(capacity_wh=50.0, full_v=25.0, empty_v=20.0, idle_w=25.0)


class SimulatedMotors:
    """A motor model in simulated time."""

    def __init__(self, battery: Battery | None = None, *, share: float = 0.0) -> None:
        self.health = MotorModel(UR5.joints, battery, seed="arm")
        self.share = share
        self.time_s = 0.0
        self.health.observe(0.0, MOST * share, STILL)

    def advance(self, duration_s: float, *, step_s: float = 1.0) -> dict[str, Any]:
        for _ in range(round(duration_s / step_s)):
            self.time_s += step_s
            self.health.observe(self.time_s, MOST * self.share, STILL)
        return dict(self.health.values())


def test_a_resting_or_stopped_joint_keeps_its_temperature() -> None:
    values = SimulatedMotors().advance(3600)
    assert set(values) == {f"{name}.{joint}" for name in ("temperature_c", "load") for joint in NAMES}
    for joint in NAMES:
        assert values[f"temperature_c.{joint}"] == pytest.approx(AMBIENT_C + IDLE_RISE_C, abs=0.5)
        assert values[f"load.{joint}"] == 0.0
    stopped = SimulatedMotors(share=1.0)
    stopped.time_s += 86_400  # the world was stopped
    assert stopped.advance(1)["temperature_c.elbow"] < AMBIENT_C + IDLE_RISE_C + 1


def test_a_loaded_joint_warms_with_the_square_of_its_torque() -> None:
    motors, fine = SimulatedMotors(share=0.5), SimulatedMotors(share=0.5)
    idle_c, rise_c = AMBIENT_C + IDLE_RISE_C, FULL_RISE_C * 0.25
    first_c = motors.advance(WARMING_S)["temperature_c.elbow"]
    assert first_c == pytest.approx(idle_c + 0.632 * rise_c, abs=1.0)
    assert fine.advance(WARMING_S, step_s=0.1)["temperature_c.elbow"] == pytest.approx(first_c, abs=0.5)
    last = motors.advance(10 * WARMING_S)
    assert last["temperature_c.elbow"] == pytest.approx(idle_c + rise_c, abs=1.0)
    assert last["load.elbow"] == pytest.approx(0.5, abs=0.01)


def test_an_overheating_joint_cools_after_the_fault() -> None:
    motors, idle_c = SimulatedMotors(), AMBIENT_C + IDLE_RISE_C
    motors.health.inject(InjectedFaults(overheating={"elbow": 2.0}))
    values = motors.advance(1200)
    assert values["temperature_c.elbow"] == pytest.approx(idle_c + 40 + IDLE_RISE_C * 1200 / WARMING_S, abs=1)
    assert values["temperature_c.wrist_1"] == pytest.approx(idle_c, abs=0.5)
    motors.health.inject(NO_FAULTS)
    assert motors.advance(10 * WARMING_S)["temperature_c.elbow"] == pytest.approx(idle_c, abs=0.5)


def test_a_battery_discharges_and_recharges() -> None:
    motors = SimulatedMotors(BATTERY)
    half = motors.advance(3600)
    assert half["battery_percent"] == pytest.approx(50.0, abs=0.5)
    assert half["battery_v"] == pytest.approx(22.5, abs=0.1)
    assert half["charging"] is False
    values = [motors.advance(60, step_s=5.0) for _ in range(200)]
    emptiest = min(value["battery_percent"] for value in values)
    assert any(value["charging"] for value in values)
    assert PLUGGED_IN_PERCENT - 1 < emptiest <= PLUGGED_IN_PERCENT + 0.5
    assert values[-1]["battery_percent"] > emptiest
    idle, busy = (SimulatedMotors(BATTERY, share=share).advance(60)["battery_percent"] for share in (0.0, 0.1))
    assert busy < idle - 0.2


def test_battery_charge_and_charger_can_be_injected() -> None:
    motors = SimulatedMotors(BATTERY)
    motors.health.inject(InjectedFaults(battery_percent=4.0, charging=False))
    assert motors.advance(10)["battery_percent"] < 4.0
    assert motors.advance(7200)["battery_percent"] == 0.0
    motors.health.inject(InjectedFaults(charging=True))
    assert motors.advance(720)["battery_percent"] == pytest.approx(10.0, abs=0.5)


def test_a_motor_at_its_limit_without_motion_has_stalled() -> None:
    health = SimulatedMotors().health
    behind = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    effort = np.where(behind > 0, MOST, 0.0)
    assert [name for _ in range(4) for name in health.stalled(0.1, behind, effort, STILL)] == []
    assert health.stalled(0.1, behind, effort, STILL) == ["elbow"]
    health.clear()
    assert health.stalled(0.1, behind, effort, STILL) == []
    for state in (
        (np.zeros(6), effort, STILL),  # in position under load
        (behind, effort * 0.5, STILL),  # below its limit
        (behind, effort, np.full(6, 0.1)),  # in motion
    ):
        health.clear()
        assert [name for _ in range(30) for name in health.stalled(0.1, *state)] == []


def test_fingers_that_an_object_stops_have_not_stalled() -> None:
    health = MotorModel(UR5.joints, None, grips=("elbow",))
    behind = np.array([0.0, 0.0, 0.3, 0.3, 0.0, 0.0])
    effort = np.where(behind > 0, MOST, 0.0)
    stalled = [name for _ in range(30) for name in health.stalled(0.1, behind, effort, STILL)]
    assert set(stalled) == {"wrist_1"}


# ------------------------------------------------------------ the file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('stuck = ["nose"]', "no joint 'nose'; valid joints: shoulder_pan, shoulder_lift"),
        ("broken = true", "unknown field `broken`; valid fields: overheating, weak, stuck"),
        ("stuck = [", "valid fields: overheating"),
        ("weak = { elbow = 2.0 }", "<= 1"),
        ("overheating = { elbow = nan }", "> 0"),
    ],
)
def test_an_invalid_fault_file_is_rejected_with_valid_names(text: str, message: str) -> None:
    with pytest.raises(ProtocolError, match="valid") as error:
        read(text, NAMES)
    assert message in str(error.value)


def test_the_fault_file_may_appear_change_and_disappear(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "arm.toml"
    injector = FaultInjector(path, NAMES)
    assert injector.poll() is None
    path.write_text(
        'overheating = { elbow = 2.0 }\nweak = { wrist_1 = 0.3 }\nstuck = ["elbow"]\nbattery_percent = 25.0\n'
    )
    assert injector.poll() == InjectedFaults(
        overheating={"elbow": 2.0}, weak={"wrist_1": 0.3}, stuck=("elbow",), battery_percent=25.0
    )
    assert injector.poll() is None
    path.write_text('stuck = ["nose"]')
    assert injector.poll() is None
    assert injector.poll() is None
    assert caplog.text.count("no joint 'nose'") == 1
    path.unlink()
    assert injector.poll() == NO_FAULTS
    path.mkdir()
    assert injector.poll() is None
    assert FaultInjector(None, NAMES).poll() is None


# ------------------------------------------------------------ in the simulation


@pytest.fixture
def faults(tmp_path: Path) -> Path:
    return tmp_path / "faults.toml"


@pytest.fixture
def arm(faults: Path) -> Iterator[MujocoDriver]:
    driver = load("mujoco")(UR5, ROBOTS / "ur5", {"faults": str(faults)}, "arm")
    assert isinstance(driver, MujocoDriver)
    driver.connect()
    yield driver
    driver.close()


def hold(arm: MujocoDriver, target: list[float], until: Callable[[], bool]) -> None:
    end_s = time.monotonic() + WITHIN_S
    while not until():
        assert time.monotonic() < end_s, "not in time"
        arm.send(target)
        time.sleep(0.01)


@pytest.mark.slow
def test_a_stuck_joint_is_an_error_until_reconnect(arm: MujocoDriver, faults: Path) -> None:
    home = list(arm.observe().position_rad)
    target = [home[0], home[1], home[2] - 0.4, *home[3:]]
    faults.write_text('stuck = ["elbow"]')
    arm.report("health")
    with pytest.raises(DriverError, match=r"^elbow does not move at full motor effort"):
        hold(arm, target, lambda: not arm.observe())
    arm.connect()  # as the control loop does
    assert arm.observe().position_rad[2] == pytest.approx(home[2], abs=0.05)
    faults.unlink()
    arm.report("health")
    hold(arm, target, lambda: abs(arm.observe().position_rad[2] - target[2]) < 0.01)


@pytest.mark.slow
def test_a_weak_joint_yields(arm: MujocoDriver, faults: Path) -> None:
    faults.write_text("weak = { shoulder_lift = 0.05 }")
    arm.report("health")
    hold(arm, [0.0, 0.0, 0.0, -1.57, -1.57, 0.0], lambda: arm.observe().position_rad[1] > 0.05)
