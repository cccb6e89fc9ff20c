"""The MuJoCo driver beyond the contract of all drivers."""

import math
import time
from collections.abc import Callable, Iterator
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

pytestmark = pytest.mark.slow
TYPE = robot_type.load(UR5)


def alone(kind: RobotType = TYPE, scene: Path = UR5 / "scene.xml") -> MujocoDriver:
    return MujocoDriver(robot_type=kind, world=World(scene, home=kind.home_rad), device="arm")


def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.002)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "room.xml"
    path.write_text("<mujoco/>")
    return path


@pytest.fixture
def arm() -> Iterator[MujocoDriver]:
    driver = alone()
    driver.connect()
    yield driver
    driver.close()


def test_frames_are_those_of_the_model(arm: MujocoDriver):
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
    bodies = alone(msgspec.structs.replace(TYPE, frames=("forearm", "elbow")))
    bodies.connect()
    forearm, elbow = bodies.observe().frames
    bodies.close()
    assert math.dist(forearm[:3], elbow[:3]) == pytest.approx(0.39225, abs=1e-6)


def test_frames_are_relative_to_the_base(arm: MujocoDriver, room: Path):
    turned = Placement(
        prefix="x/", model=UR5 / "ur5.xml", position_m=(3.0, -2.0, 1.0), quaternion=(0.5, 0.5, -0.5, 0.5)
    )
    world = World(room, robots=[turned], home={f"x/{name}": value for name, value in TYPE.home_rad.items()})
    away = MujocoDriver(robot_type=TYPE, world=world, device="away", prefix="x/")
    away.connect()
    try:
        for expected, measured in zip(arm.observe().frames, away.observe().frames, strict=True):
            assert measured == pytest.approx(expected, abs=2e-3)  # gravity differs, but its compensation is exact
    finally:
        away.close()


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
def test_missing_names_are_reported_and_stop_the_simulation(change: dict[str, object], message: str):
    driver = alone(msgspec.structs.replace(TYPE, **change))
    with pytest.raises(DriverError, match=message):
        driver.connect()
    assert driver._world._thread is None
    with pytest.raises(DriverError, match="not connected"):
        driver.observe()


def test_other_actuators_than_position_servos_are_rejected(tmp_path: Path):
    scene = tmp_path / "motor.xml"
    servo = '<position name="elbow" joint="elbow" class="ur5_large"/>'
    motor = '<motor name="elbow" joint="elbow" ctrlrange="-1 1"/>'
    scene.write_text((UR5 / "ur5.xml").read_text().replace(servo, motor))
    with pytest.raises(DriverError, match="actuator 'elbow' of 'ur5' is not a position servo on joint 'elbow'"):
        alone(scene=scene).connect()


def test_a_fault_of_the_world_is_an_error_until_a_reconnect_restarts_at_home(arm: MujocoDriver):
    home = arm.observe().position_rad
    arm.send([0.3, *home[1:]])
    until(lambda: arm.observe().position_rad[0] > home[0] + 0.01)
    arm._world._data.qvel[:] = np.nan
    until(lambda: bool(arm._world.snapshot().fault))
    for call in (arm.observe, lambda: arm.send([0.0] * 6)):
        with pytest.raises(DriverError, match="unstable"):
            call()
    stopped_s = arm._world.snapshot().time_s
    arm.connect()
    assert arm._world.snapshot().time_s >= stopped_s
    assert arm.observe().position_rad == pytest.approx(home, abs=1e-3)
    until(lambda: arm._world.snapshot().time_s > stopped_s + 0.02)
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


def test_two_drivers_move_their_own_robot_only(room: Path):
    home_rad = {prefix + name: value for prefix in ("a/", "b/") for name, value in TYPE.home_rad.items()}
    robots = [
        Placement(prefix=prefix, model=UR5 / "ur5.xml", position_m=(x, 0, 0)) for prefix, x in (("a/", 0), ("b/", 3))
    ]
    world = World(room, robots=robots, home=home_rad)
    first, second = (MujocoDriver(robot_type=TYPE, world=world, device=name, prefix=f"{name}/") for name in "ab")
    first.connect()
    second.connect()
    try:
        home = second.observe().position_rad
        first.send([0.3, *home[1:]])
        second.send(home)
        until(lambda: abs(first.observe().position_rad[0] - 0.3) < 0.01)
        assert second.observe().position_rad == pytest.approx(home, abs=1e-3)
        twin = second.twin()
        assert twin is not None
        assert [body.name for body in twin.bodies[:2]] == ["scene", "base"]
        first.close()
        before_s = world.snapshot().time_s
        until(lambda: world.snapshot().time_s > before_s)
        second.observe()
    finally:
        first.close()
        second.close()
