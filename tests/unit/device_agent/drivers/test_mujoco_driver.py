"""The MuJoCo driver beyond the contract of all drivers."""

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from device_agent.drivers.mujoco import MujocoDriver, Placement, World
from device_agent.drivers.mujoco import driver as driver_module
from device_agent.ports.driver import DriverError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import UR5

TYPE = robot_type.load(UR5)


def alone(kind: RobotType = TYPE, scene: Path = UR5 / "scene.xml") -> MujocoDriver:
    return MujocoDriver(robot_type=kind, world=World(scene, home=kind.home_rad), device="arm")


@pytest.fixture
def arm() -> Iterator[MujocoDriver]:
    driver = alone()
    driver.connect()
    yield driver
    driver.close()


def test_frames_are_relative_to_the_base(arm: MujocoDriver, tmp_path: Path):
    room = tmp_path / "room.xml"
    room.write_text("<mujoco/>")
    turned = Placement(
        prefix="x/", model=UR5 / "ur5.xml", position_m=(3.0, -2.0, 1.0), quaternion=(0.5, 0.5, -0.5, 0.5)
    )
    world = World(room, robots=[turned], home={f"x/{name}": value for name, value in TYPE.home_rad.items()})
    away = MujocoDriver(robot_type=TYPE, world=world, device="away", prefix="x/")
    away.connect()
    try:
        for here, there in zip(arm.observe().frames, away.observe().frames, strict=True):
            assert there == pytest.approx(here, abs=2e-3)  # gravity differs, but its compensation is exact
    finally:
        away.close()


def test_the_flange_pose_matches_the_simulation(arm: MujocoDriver):
    observation = arm.observe()
    model = mujoco.MjModel.from_xml_path(str(UR5 / "scene.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = observation.position_rad
    mujoco.mj_kinematics(model, data)
    flange = observation.frames[TYPE.frames.index("flange")]
    assert flange[:3] == pytest.approx(data.site("flange").xpos, abs=1e-9)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array(flange[3:]))
    assert matrix == pytest.approx(data.site("flange").xmat, abs=1e-9)


def test_a_frame_may_be_a_body():
    driver = alone(msgspec.structs.replace(TYPE, frames=("forearm", "elbow")))
    driver.connect()
    try:
        forearm, elbow = driver.observe().frames
    finally:
        driver.close()
    assert np.linalg.norm(np.subtract(forearm[:3], elbow[:3])) == pytest.approx(0.39225, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": ("flanch",)}, r"no site or body 'flanch'; it has: .*forearm"),
        (
            {"joints": (msgspec.structs.replace(TYPE.joints[0], name="waist"),), "home_rad": {}},
            r"no joint 'waist'; it has: shoulder_pan",
        ),
    ],
)
def test_missing_names_are_reported_with_the_valid_ones(change: dict[str, object], message: str):
    driver = alone(msgspec.structs.replace(TYPE, **change))
    with pytest.raises(DriverError, match=message):
        driver.connect()
    with pytest.raises(DriverError, match="not connected"):
        driver.observe()


def test_other_actuators_than_position_servos_are_rejected(tmp_path: Path):
    scene = tmp_path / "motor.xml"
    scene.write_text(
        (UR5 / "ur5.xml")
        .read_text()
        .replace(
            '<position name="elbow" joint="elbow" class="ur5_large"/>',
            '<motor name="elbow" joint="elbow" ctrlrange="-1 1"/>',
        )
    )
    with pytest.raises(DriverError, match="actuator 'elbow' of 'ur5' is not a position servo on joint 'elbow'"):
        alone(scene=scene).connect()


def test_a_failed_connect_leaves_no_simulation_running():
    world = World(UR5 / "scene.xml")
    driver = MujocoDriver(robot_type=msgspec.structs.replace(TYPE, frames=("nowhere",)), world=world, device="arm")
    with pytest.raises(DriverError):
        driver.connect()
    stopped = world.snapshot().time_s
    time.sleep(0.03)
    assert world.snapshot().time_s == stopped


def test_a_fault_of_the_world_reaches_observe_and_send(arm: MujocoDriver):
    arm._world._data.qvel[:] = np.nan
    end = time.monotonic() + 60
    while not arm._world.snapshot().fault:
        assert time.monotonic() < end
        time.sleep(0.002)
    with pytest.raises(DriverError, match="unstable"):
        arm.observe()
    with pytest.raises(DriverError, match="unstable"):
        arm.send([0.0] * 6)


def test_reconnecting_after_a_fault_restarts_at_home(arm: MujocoDriver):
    home = arm.observe().position_rad
    arm.send([0.3, *home[1:]])
    time.sleep(0.05)
    arm._world._data.qvel[:] = np.nan
    end = time.monotonic() + 60
    while not arm._world.snapshot().fault:
        assert time.monotonic() < end
        time.sleep(0.002)
    stopped = arm._world.snapshot().time_s
    arm.connect()
    assert arm._world.snapshot().time_s >= stopped
    assert arm.observe().position_rad == pytest.approx(home, abs=1e-3)
    while arm._world.snapshot().time_s <= stopped + 0.02:
        assert time.monotonic() < end
        time.sleep(0.002)
    assert arm.observe().position_rad == pytest.approx(home, abs=1e-3)


def test_a_hanging_simulation_is_detected(arm: MujocoDriver, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(driver_module, "STALE_S", -1.0)
    with pytest.raises(DriverError, match="has not moved for"):
        arm.observe()


def test_periodic_targets_give_smooth_motion():
    """The velocity stays within 1 % once the servo follows."""
    world = World(UR5 / "scene.xml", home=TYPE.home_rad)
    world.build()
    driver = MujocoDriver(robot_type=TYPE, world=world, device="arm")
    driver._resolve(world.model)
    driver._connected = True
    home = [TYPE.home_rad[joint.name] for joint in TYPE.joints]
    speeds = []
    for period in range(1, 120):
        driver.send([home[0] + period * 0.008 * 1.0, *home[1:]])
        for _ in range(4):
            world.step(1)
            speeds.append(driver.observe().velocity_rad_s[0])
    assert np.abs(np.array(speeds[240:]) - 1.0).max() < 0.01


def test_two_drivers_move_their_own_robot_only(tmp_path: Path):
    room = tmp_path / "room.xml"
    room.write_text("<mujoco/>")
    world = World(
        room,
        robots=[
            Placement(prefix="a/", model=UR5 / "ur5.xml"),
            Placement(prefix="b/", model=UR5 / "ur5.xml", position_m=(3.0, 0.0, 0.0)),
        ],
        home={prefix + name: value for prefix in ("a/", "b/") for name, value in TYPE.home_rad.items()},
    )
    first = MujocoDriver(robot_type=TYPE, world=world, device="first", prefix="a/")
    second = MujocoDriver(robot_type=TYPE, world=world, device="second", prefix="b/")
    first.connect()
    second.connect()
    try:
        home = second.observe().position_rad
        first.send([0.3, *home[1:]])
        second.send(home)
        end = time.monotonic() + 60
        while abs(first.observe().position_rad[0] - 0.3) > 0.01:
            assert time.monotonic() < end
            time.sleep(0.005)
        assert second.observe().position_rad == pytest.approx(home, abs=1e-3)
        twin = second.twin()
        assert twin is not None
        assert [body.name for body in twin.bodies[:2]] == ["scene", "base"]
        first.close()
        before = world.snapshot().time_s
        while world.snapshot().time_s == before:
            assert time.monotonic() < end
            time.sleep(0.002)
        second.observe()
    finally:
        first.close()
        second.close()
