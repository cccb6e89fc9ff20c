"""The driver with ROS 1 of Debian: a real master, a robot as a node, and ROS's own tools."""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from device_agent import drivers
from device_agent.drivers.ros import RosDriver
from device_agent.middleware.ros.connection import Connection, Publication, Subscription
from device_agent.middleware.ros.messages import Twist
from device_agent.middleware.ros.rospy_channel import RospyChannel
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.paths import UR5
from tests.harness.robots.ros.ros_system import PYTHON, RosRobot, RosSystem, ros_system, until

TYPE = robot_types.load(UR5)
HOME = [TYPE.home_rad[joint.name] for joint in TYPE.joints]
REST_S = 0.35


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSystem]:
    with ros_system(tmp_path_factory.mktemp("ros")) as system:
        yield system


@pytest.fixture
def robot(system: RosSystem) -> Iterator[RosRobot]:
    robot = RosRobot(system, TYPE)
    yield robot
    robot.kill()


@pytest.fixture
def driver(system: RosSystem) -> Iterator[RosDriver]:
    driver = create(system)
    yield driver
    driver.close()


def create(system: RosSystem, **changes: object) -> RosDriver:
    options: dict[str, object] = {
        "connection": "rospy",
        "master": system.uri,
        "names": {joint.name: f"{joint.name}_joint" for joint in TYPE.joints},
        "command": {"topic": "/arm_controller/command"},
        "safety": [{"topic": "/emergency_stop", "type": "std_msgs/Bool", "normal": [False]}],
        **changes,
    }
    driver = drivers.load("ros")(TYPE, UR5, options, "arm")
    assert isinstance(driver, RosDriver)
    return driver


def reconnect(driver: RosDriver) -> None:
    def connects() -> bool:
        try:
            driver.connect()
        except UnreachableError:
            return False
        return True

    until(connects)


def move_until(driver: RosDriver, robot: RosRobot, condition: Callable[[dict[str, Any]], bool]) -> None:
    """Command a target 1 rad away until the robot's state fulfils a condition."""
    target = [value + 1.0 for value in robot.positions()]

    def moves() -> bool:
        driver.send(target)
        return condition(robot.state())

    until_often(moves)


def until_often(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def rests(robot: RosRobot) -> float:
    """Wait for rest; returns the time between the last command and rest, on the robot's clock [s]."""
    until(lambda: (state := robot.state())["time_s"] > max(state["moved_s"], state["command_s"]) + 0.3)
    state = robot.state()
    return float(state["moved_s"] - state["command_s"])


def is_fast(state: dict[str, Any]) -> bool:
    return bool(max(state["velocity"].values()) > 2.0)


def test_the_arm_moves_and_stops_by_rostopic(system: RosSystem, robot: RosRobot, driver: RosDriver) -> None:
    driver.connect()
    target = [value + 0.02 * (index + 1) for index, value in enumerate(robot.positions())]

    def arrives() -> bool:
        driver.send(target)
        return robot.positions() == pytest.approx(target, abs=0.002)

    until_often(arrives)
    assert driver.observe().position_rad == pytest.approx(target, abs=0.01)
    echoed = system.run("rostopic", "echo", "-n", "1", "/joint_states/name").stdout
    assert "elbow_joint" in echoed
    stop = system.start("rostopic", "pub", "-r", "10", "/emergency_stop", "std_msgs/Bool", "data: true")
    until(lambda: [fault.code for fault in driver.faults()] == ["safety"])
    with pytest.raises(DriverError, match="/emergency_stop: 'data' is true"):
        driver.send(target)
    os.killpg(stop.pid, signal.SIGKILL)


def test_a_restart_of_the_master_ends_the_motion(system: RosSystem, robot: RosRobot, driver: RosDriver) -> None:
    driver.connect()
    move_until(driver, robot, is_fast)
    system.stop_master()
    with pytest.raises(UnreachableError, match="the ROS master does not answer"):
        move_until(driver, robot, lambda _: False)
    assert rests(robot) <= REST_S
    with pytest.raises(UnreachableError, match="no ROS master at 127"):
        driver.connect()
    before = robot.positions()
    robot.kill()
    system.start_master()
    again = RosRobot(system, TYPE)
    try:
        reconnect(driver)
        time.sleep(0.2)
        assert again.positions() == pytest.approx(HOME, abs=1e-3)
        assert before != pytest.approx(HOME, abs=0.1)
        move_until(driver, again, is_fast)
    finally:
        again.kill()


def test_a_master_that_was_replaced_is_noticed(system: RosSystem, robot: RosRobot, driver: RosDriver) -> None:
    driver.connect()
    connection = driver._connection
    assert connection is not None
    process = connection._channel.process  # type: ignore[attr-defined]
    os.kill(process.pid, signal.SIGSTOP)
    system.stop_master()
    system.start_master()
    os.kill(process.pid, signal.SIGCONT)
    until(lambda: connection.lost)
    with pytest.raises(UnreachableError, match="the ROS master was replaced"):
        driver.observe()
    assert robot.positions() == pytest.approx(HOME, abs=1e-3)


def test_a_bridge_that_crashes_ends_the_motion(robot: RosRobot, driver: RosDriver) -> None:
    driver.connect()
    move_until(driver, robot, is_fast)
    connection = driver._connection
    assert connection is not None
    process = connection._channel.process  # type: ignore[attr-defined]
    process.kill()
    with pytest.raises(UnreachableError, match="is lost"):
        move_until(driver, robot, lambda _: False)
    assert rests(robot) <= REST_S
    before = robot.positions()
    reconnect(driver)
    time.sleep(0.2)
    assert robot.positions() == pytest.approx(before, abs=1e-3)
    driver.close()
    assert process.poll() is not None


def open_connection(system: RosSystem, received: list[Twist]) -> tuple[Connection, RospyChannel]:
    channel = RospyChannel(python=PYTHON, folders=(), master=system.uri, node="test")
    connection = Connection(
        channel,
        subscriptions=[Subscription("/cmd_vel", "geometry_msgs/Twist", Twist, lambda twist, _: received.append(twist))],
        advertised={"/cmd_vel": "geometry_msgs/Twist"},
        device="base",
        clock=time.monotonic,
    )
    return connection, channel


def drive(connection: Connection) -> None:
    twist = {"linear": {"x": 0.2, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
    connection.publish(Publication("/cmd_vel", twist))


def test_the_bridge_brakes_a_base_without_commands(system: RosSystem) -> None:
    received: list[Twist] = []
    connection, _ = open_connection(system, received)

    def arrives() -> bool:
        drive(connection)
        return bool(received)

    until(arrives)
    until(lambda: received[-1].linear.x == 0.0)
    connection.close()


def test_the_bridge_brakes_a_base_when_the_agent_ends(system: RosSystem) -> None:
    received: list[Twist] = []
    watching, _ = open_connection(system, received)
    driving, _ = open_connection(system, [])

    def arrives() -> bool:
        drive(driving)
        return bool(received)

    until(arrives)
    drive(driving)
    driving.close()
    until(lambda: received[-1].linear.x == 0.0)
    watching.close()


def connect(system: RosSystem, *, subscriptions: list[Subscription], needs_subscribers: bool) -> Connection:
    return Connection(
        RospyChannel(python=PYTHON, folders=(), master=system.uri, node="x", needs_subscribers=needs_subscribers),
        subscriptions=subscriptions,
        advertised={} if subscriptions else {"/heard": "std_msgs/Bool"},
        device="test",
        clock=time.monotonic,
    )


def test_the_loss_of_the_last_subscriber_ends_only_a_channel_that_needs_one(system: RosSystem) -> None:
    received: list[bool] = []
    heard = Subscription("/heard", "std_msgs/Bool", dict[str, bool], lambda bit, _: received.append(bit["data"]))
    listener = connect(system, subscriptions=[heard], needs_subscribers=False)
    robot = connect(system, subscriptions=[], needs_subscribers=True)
    display = connect(system, subscriptions=[], needs_subscribers=False)

    def both_arrive() -> bool:
        robot.publish(Publication("/heard", {"data": True}))
        display.publish(Publication("/heard", {"data": False}))
        return {True, False} <= set(received)

    until_often(both_arrive)
    listener.close()
    until_often(lambda: robot.lost)
    assert "/heard has no subscriber" in robot.problem
    received.clear()
    listener = connect(system, subscriptions=[heard], needs_subscribers=False)

    def arrives() -> bool:
        display.publish(Publication("/heard", {"data": False}))
        return bool(received)

    until_often(arrives)
    for connection in (listener, robot, display):
        connection.close()


def test_messages_that_are_not_installed_are_reported(system: RosSystem, robot: RosRobot) -> None:
    del robot
    driver = create(system, safety=[{"topic": "/mode", "type": "no_msgs/Mode", "field": "mode", "normal": [1]}])
    with pytest.raises(UnreachableError, match=r"/mode .*ROS reports: ModuleNotFoundError: No module named 'no_msgs'"):
        driver.connect()


def test_a_missing_rospy_is_reported(system: RosSystem, tmp_path: Path) -> None:
    with pytest.raises(UnreachableError, match="the Python of the ROS bridge cannot be started"):
        create(system, python=str(tmp_path / "python")).connect()
    with pytest.raises(UnreachableError, match="rospy cannot be used: ModuleNotFoundError"):
        create(system, python=sys.executable).connect()
