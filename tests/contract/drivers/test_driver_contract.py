"""The simulation's driver fulfils the contract of its port."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.drivers import load
from device_agent.drivers.mujoco import MujocoDriver, Placement, World
from device_agent.drivers.testing.driver_contract import DriverContract
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import Driver, ReportsStreams, Twist
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import ROBOTS

TYPES = sorted(path.parent.name for path in ROBOTS.glob("*/robot.toml"))


class SimulatedPeer:
    """The robot in the world of its driver."""

    def __init__(self, driver: MujocoDriver) -> None:
        self._driver = driver

    def joint_positions(self) -> tuple[float, ...]:
        return tuple(self._driver._world.snapshot().qpos[self._driver._qpos].tolist())

    def joint_velocities(self) -> tuple[float, ...]:
        return tuple(self._driver._world.snapshot().qvel[self._driver._dof].tolist())

    def base_twist(self) -> Twist:
        assert isinstance(self._driver, ReportsStreams)
        self._driver.observe()
        odometry = self._driver.report("odometry")
        return Twist(*(float(odometry.get(name, 0.0)) for name in Twist._fields))

    def disturb(self, disturbance: Disturbance) -> None:
        raise NotImplementedError(disturbance)

    def restore(self) -> None:
        raise NotImplementedError


class MujocoContract(DriverContract):
    simulated = True
    absent = dict.fromkeys(Disturbance, "the simulation runs in the agent's process and has no safety controller")

    @pytest.fixture
    def peer(self, driver: Driver) -> SimulatedPeer:
        assert isinstance(driver, MujocoDriver)
        return SimulatedPeer(driver)


class TestMujocoAlone(MujocoContract):
    """Each shipped type in its own scene, as the agent loads it."""

    @pytest.fixture(params=TYPES)
    def robot_type(self, request: pytest.FixtureRequest) -> RobotType:
        return robot_type.load(ROBOTS / request.param)

    @pytest.fixture
    def driver(self, robot_type: RobotType) -> Iterator[Driver]:
        driver = load("mujoco")(robot_type, ROBOTS / robot_type.type, {}, "arm")
        yield driver
        driver.close()


class TestMujocoShared(MujocoContract):
    """The second of two UR5s in one world, turned and away from the origin."""

    @pytest.fixture
    def robot_type(self) -> RobotType:
        return robot_type.load(ROBOTS / "ur5")

    @pytest.fixture
    def driver(self, robot_type: RobotType, tmp_path: Path) -> Iterator[Driver]:
        room = tmp_path / "room.xml"
        room.write_text('<mujoco><worldbody><geom type="plane" size="5 5 0.1"/></worldbody></mujoco>')
        model = ROBOTS / "ur5" / robot_type.model
        world = World(
            room,
            robots=[
                Placement(prefix="left/", model=model, position_m=(0.0, 1.0, 0.5)),
                Placement(prefix="right/", model=model, position_m=(0.0, -1.0, 0.5), quaternion=(0.6, 0.0, 0.0, 0.8)),
            ],
            home={
                prefix + name: value for prefix in ("left/", "right/") for name, value in robot_type.home_rad.items()
            },
        )
        driver = MujocoDriver(robot_type=robot_type, world=world, device="right", prefix="right/")
        yield driver
        driver.close()
