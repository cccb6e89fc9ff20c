"""What the driver of LeRobot's robots does beyond the driver contract."""

import fcntl
import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from device_agent.drivers import load
from device_agent.drivers.lerobot.driver import LerobotDriver, LerobotMobileDriver
from device_agent.ports.driver import DriverError, MobileDriver, Twist, UnreachableError
from device_agent.protocol.manifests import robot_type
from device_agent.protocol.manifests.robot_type import RobotType
from tests.harness.paths import LEROBOT_PYTHON, LEROBOT_PYTHONS, ROBOTS
from tests.harness.robots.lerobot.peer import CENTER, TICKS, ServoPeer

SO101 = robot_type.load(ROBOTS / "so101")
LEKIWI = robot_type.load(ROBOTS / "lekiwi")
NAMES = [joint.name for joint in SO101.joints]
HOME = tuple(SO101.home_rad[name] for name in NAMES)
PAN, GRIPPER = NAMES.index("shoulder_pan"), NAMES.index("gripper")


def until(condition: Callable[[], object], within_s: float = 60.0) -> None:
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def create(peer: ServoPeer, kind: RobotType = SO101, **options: str) -> LerobotDriver:
    driver = load("lerobot")(kind, ROBOTS / kind.type, {**peer.options(), **options}, "arm")
    assert isinstance(driver, LerobotDriver)
    return driver


def codes(driver: LerobotDriver) -> list[tuple[str, bool]]:
    return [(fault.code, fault.stops) for fault in driver.faults()]


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[ServoPeer]:
    peer = ServoPeer(SO101, "so101_follower", LEROBOT_PYTHON, tmp_path)
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: ServoPeer) -> Iterator[LerobotDriver]:
    driver = create(peer)
    driver.connect()
    yield driver
    driver.close()


def lost(driver: LerobotDriver) -> bool:
    try:
        driver.observe()
    except UnreachableError:
        return True
    return False


# ------------------------------------------------------------ connecting


def test_servos_get_torque_at_their_position_and_keep_it_at_the_end(peer: ServoPeer) -> None:
    before = peer.joint_positions()
    driver = create(peer)
    driver.connect()
    state = peer.state()
    for name in NAMES:
        assert state[name]["Torque_Enable"] == 1
        assert state[name]["Goal_Position"] == pytest.approx(state[name]["position"], abs=2)
        speed = math.ceil(SO101.joints[0].max_velocity_rad_s * TICKS / math.tau)
        assert state[name]["Goal_Velocity"] == speed
    driver.close()
    assert all(servo["Torque_Enable"] == 1 for servo in peer.state().values())
    assert peer.joint_positions() == pytest.approx(before, abs=5e-3)


def test_connecting_to_servos_with_torque_never_removes_it(peer: ServoPeer, driver: LerobotDriver) -> None:
    peer.state()
    driver.connect()
    writes = {write for servo in peer.state().values() for write in servo["writes"]}
    assert "Torque_Enable" not in writes


def test_holding_keeps_a_goal_that_carries_the_load_and_gives_in_otherwise(
    peer: ServoPeer, driver: LerobotDriver
) -> None:
    driver.close()
    position = {name: round(peer.state()[name]["position"]) for name in ("elbow_flex", "wrist_flex")}
    goals = {"elbow_flex": position["elbow_flex"] + 40, "wrist_flex": position["wrist_flex"] + 400}
    peer.disturb("safety")  # nothing moves
    peer.state(set={name: {"Goal_Position": goal} for name, goal in goals.items()})
    driver.connect()
    state = peer.state()
    assert state["elbow_flex"]["Goal_Position"] == goals["elbow_flex"]
    assert state["wrist_flex"]["Goal_Position"] == pytest.approx(position["wrist_flex"], abs=2)


def test_a_calibration_that_differs_is_described(peer: ServoPeer) -> None:
    peer.state(set={"elbow_flex": {"Max_Position_Limit": 3000}})
    with pytest.raises(UnreachableError, match=r"elbow_flex have another calibration.*lerobot-calibrate"):
        create(peer).connect()
    with pytest.raises(UnreachableError, match=r"no calibration of this robot in .*other\.json"):
        create(peer, id="other").connect()


def test_a_missing_servo_and_a_wrong_one_are_named(peer: ServoPeer) -> None:
    peer.state(set={"wrist_roll": {"Model_Number": 1284}})
    with pytest.raises(UnreachableError, match="wrist_roll is not a sts3215"):
        create(peer).connect()
    peer.disturb("silence")
    with pytest.raises(UnreachableError, match=r"no response from the servos of: shoulder_pan, .*gripper"):
        create(peer).connect()


def test_a_port_that_another_program_uses_is_described(peer: ServoPeer) -> None:
    port = os.open(peer.port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(port, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(UnreachableError, match="cannot be opened"):
            create(peer).connect()
    finally:
        os.close(port)


def test_joints_of_another_robot_are_described(peer: ServoPeer) -> None:
    with pytest.raises(UnreachableError, match="joints of the robot type must be: shoulder_pan, shoulder_lift"):
        create(peer, LEKIWI).connect()
    with pytest.raises(UnreachableError, match="both have a base, or none"):
        create(peer, msgspec.structs.replace(SO101, base=LEKIWI.base)).connect()


def test_a_missing_interpreter_or_library_is_described(peer: ServoPeer) -> None:
    for python in ("/missing/python", "/usr/bin/python3"):
        with pytest.raises(UnreachableError, match=r"Python|not complete"):
            create(peer, python=python).connect()


# ------------------------------------------------------------ motion


def test_degrees_and_percent_are_radians_on_the_encoders(peer: ServoPeer, driver: LerobotDriver) -> None:
    target = list(HOME)
    target[PAN], target[GRIPPER] = 0.5, 1.0
    until(lambda: driver.send(target) and abs(driver.observe().position_rad[PAN] - 0.5) < 0.004)
    state = peer.state()
    assert state["shoulder_pan"]["Goal_Position"] == pytest.approx(CENTER + 0.5 * TICKS / math.tau, abs=2)
    closed = SO101.joints[GRIPPER].lower_rad
    assert state["gripper"]["Goal_Position"] == pytest.approx(CENTER + (1.0 - closed) * TICKS / math.tau, abs=2)


def test_commands_end_at_the_calibrated_range(tmp_path: Path) -> None:
    wide = msgspec.structs.replace(SO101.joints[PAN], lower_rad=-3.0, upper_rad=3.0)
    kind = msgspec.structs.replace(SO101, joints=(wide, *SO101.joints[1:]))
    peer = ServoPeer(SO101, "so101_follower", LEROBOT_PYTHON, tmp_path)
    driver = create(peer, kind)
    try:
        driver.connect()
        applied = driver.send((2.5, *HOME[1:]))
        assert applied[PAN] == pytest.approx(SO101.joints[PAN].upper_rad, abs=2e-3)
    finally:
        driver.close()
        peer.close()


def test_servos_keep_the_velocity_limit_of_the_robot_type(tmp_path: Path) -> None:
    slow = tuple(msgspec.structs.replace(joint, max_velocity_rad_s=0.5) for joint in SO101.joints)
    peer = ServoPeer(SO101, "so101_follower", LEROBOT_PYTHON, tmp_path)
    driver = create(peer, msgspec.structs.replace(SO101, joints=slow))
    try:
        driver.connect()
        fastest = []

        def arrives() -> bool:
            driver.send((0.4, *HOME[1:]))
            fastest.append(peer.joint_velocities()[PAN])
            return abs(peer.joint_positions()[PAN] - 0.4) < 0.01

        until(arrives)
        assert 0.4 < max(fastest) < 0.51
    finally:
        driver.close()
        peer.close()


def test_an_arm_without_commands_stops_far_from_its_goal(tmp_path: Path) -> None:
    slow = tuple(msgspec.structs.replace(joint, max_velocity_rad_s=0.5) for joint in SO101.joints)
    peer = ServoPeer(SO101, "so101_follower", LEROBOT_PYTHON, tmp_path)
    driver = create(peer, msgspec.structs.replace(SO101, joints=slow))
    try:
        driver.connect()
        driver.send((1.8, *HOME[1:]))
        until(lambda: peer.joint_velocities()[PAN] > 0.1)
        until(lambda: abs(peer.joint_velocities()[PAN]) < 0.01)
        assert peer.joint_positions()[PAN] < 1.2
    finally:
        driver.close()
        peer.close()


def test_a_killed_bridge_is_a_lost_device_and_reconnecting_holds(peer: ServoPeer, driver: LerobotDriver) -> None:
    assert driver._connection is not None
    driver._connection._bridge.process.kill()
    until(lambda: lost(driver))
    with pytest.raises(DriverError):
        driver.send(HOME)
    driver.connect()
    assert driver.observe().position_rad == pytest.approx(peer.joint_positions(), abs=0.01)


def test_a_hung_bridge_is_a_lost_device_and_is_replaced(driver: LerobotDriver) -> None:
    assert driver._connection is not None
    process = driver._connection._bridge.process
    os.kill(process.pid, signal.SIGSTOP)
    until(lambda: lost(driver))
    driver.connect()
    assert process.poll() is not None
    assert not lost(driver)


# ------------------------------------------------------------ base


@pytest.fixture
def mobile(tmp_path: Path) -> Iterator[tuple[LerobotMobileDriver, ServoPeer]]:
    peer = ServoPeer(LEKIWI, "lekiwi", LEROBOT_PYTHON, tmp_path)
    driver = create(peer, LEKIWI)
    assert isinstance(driver, LerobotMobileDriver)
    driver.connect()
    yield driver, peer
    driver.close()
    peer.close()


def test_the_base_moves_in_all_directions(mobile: tuple[LerobotMobileDriver, ServoPeer]) -> None:
    driver, peer = mobile
    assert isinstance(driver, MobileDriver)
    for twist in (Twist(0.1), Twist(0.0, 0.1), Twist(0.0, 0.0, 0.8)):

        def moves(twist: Twist = twist) -> bool:
            driver.send(HOME)
            assert driver.drive(twist) == twist
            return tuple(peer.base_twist()) == pytest.approx(tuple(twist), abs=5e-3)

        until(moves)
    assert driver.drive(Twist(9.0)) == Twist(0.2)


def test_the_base_stops_if_only_the_arm_is_commanded(mobile: tuple[LerobotMobileDriver, ServoPeer]) -> None:
    driver, peer = mobile
    until(lambda: driver.send(HOME) and driver.drive(Twist(0.1)) and peer.base_twist().forward_m_s > 0.05)
    until(lambda: driver.send(HOME) and abs(peer.base_twist().forward_m_s) < 0.005)


def test_the_base_stops_if_the_agent_ends(mobile: tuple[LerobotMobileDriver, ServoPeer]) -> None:
    driver, peer = mobile
    until(lambda: driver.send(HOME) and driver.drive(Twist(0.1)) and peer.base_twist().forward_m_s > 0.05)
    assert driver._connection is not None
    driver._connection._bridge.disconnect()  # as the end of the agent's process
    until(lambda: abs(peer.base_twist().forward_m_s) < 0.005)


def test_odometry_is_the_velocity_of_the_wheels(mobile: tuple[LerobotMobileDriver, ServoPeer]) -> None:
    driver, peer = mobile
    peer.state(set={"base_left_wheel": {"Present_Velocity": 500}})
    until(lambda: driver.report("odometry").get("forward_m_s", 0.0) < -0.01)


# ------------------------------------------------------------ faults and streams


def test_limp_servos_stop_the_robot(peer: ServoPeer, driver: LerobotDriver) -> None:
    assert codes(driver) == []
    peer.state(set={"elbow_flex": {"Torque_Enable": 0}})
    until(lambda: codes(driver) == [("torque-off", True)])
    assert "elbow_flex" in driver.faults()[0].message
    with pytest.raises(DriverError, match="stopped itself"):
        driver.send(HOME)
    driver.connect()
    assert codes(driver) == [("torque-off", True)], "only a person decides that the servo gets torque again"
    assert peer.state()["elbow_flex"]["Torque_Enable"] == 0


def test_errors_of_a_servo_are_named(peer: ServoPeer, driver: LerobotDriver) -> None:
    peer.state(set={"gripper": {"Status": 4 | 32}})
    until(lambda: codes(driver) == [("servo-error", True)])
    assert "gripper (temperature, overload)" in driver.faults()[0].message


def test_hot_servos_are_shown(peer: ServoPeer, driver: LerobotDriver) -> None:
    peer.state(set={"shoulder_lift": {"Present_Temperature": 63}})
    until(lambda: codes(driver) == [("servo-hot", False)])
    assert "shoulder_lift 63 °C" in driver.faults()[0].message
    driver.send(HOME)


def test_lost_responses_are_shown_while_the_robot_continues(peer: ServoPeer, driver: LerobotDriver) -> None:
    peer.state(drop_every=50)
    until(lambda: ("communication", False) in codes(driver))
    peer.state(drop_every=0)
    until(lambda: driver.faults() == ())


@pytest.mark.parametrize("robot", ["so101_follower", "koch_follower"])
@pytest.mark.parametrize("version", LEROBOT_PYTHONS, ids="lerobot-{}".format)
def test_late_responses_are_not_taken_for_others(robot: str, version: str, tmp_path: Path) -> None:
    peer = ServoPeer(SO101, robot, LEROBOT_PYTHONS[version], tmp_path)
    driver = create(peer)
    seen: set[object] = set()
    try:
        driver.connect()
        connection = driver._connection
        assert connection is not None
        before = driver.observe().position_rad

        def next_status() -> float:
            """Wait for a new status; note what is wrong in it."""
            connection.status = None
            until(lambda: connection.status is not None)
            seen.update(fault for fault in driver.faults() if fault.code != "communication")
            seen.update(item for item in driver.report("health").items() if item[1] not in {31.0, 12.1})
            assert driver.observe().position_rad == pytest.approx(before, abs=0.01)
            return connection.status.lost if connection.status else 0.0

        for _ in range(8):  # each time the responses to another request may be late
            before_lost, lost = 1.0, next_status()
            while lost <= before_lost:  # losses of a busy machine leave the statistics meanwhile
                peer.state(late=True)
                before_lost, lost = lost, next_status()
            for _ in range(3):
                next_status()
        assert seen == set()
    finally:
        driver.close()
        peer.close()


def test_a_wrong_checksum_is_no_measurement(peer: ServoPeer, driver: LerobotDriver) -> None:
    peer.disturb("checksum")
    until(lambda: lost(driver))
    with pytest.raises(UnreachableError):
        driver.connect()
    peer.restore()
    driver.connect()
    assert not lost(driver)


def test_it_reports_temperatures_and_voltages(driver: LerobotDriver) -> None:
    health = driver.report("health")
    assert health["temperature_c.elbow_flex"] == 31.0
    assert health["voltage_v.gripper"] == pytest.approx(12.1)
    assert len(health) == 2 * len(NAMES)
    assert driver.report("odometry") == {}


# ------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speed": "1"}, "no option 'speed'; it has: robot, port"),
        ({"robot": "ur5"}, "no robot 'ur5'; it has: koch_follower, lekiwi"),
        ({"port": ""}, "option 'port'"),
        ({"id": 1}, "option 'id'"),
        ({"python": None}, "needs the option 'python'"),
    ],
)
def test_wrong_options_are_described(change: dict[str, object], message: str) -> None:
    options = {"robot": "so101_follower", "port": "/dev/ttyACM0", "id": "arm", "python": "/opt/lerobot/bin/python"}
    changed = {name: value for name, value in (options | change).items() if value is not None}
    with pytest.raises(DriverError, match=message):
        load("lerobot")(SO101, ROBOTS / "so101", changed, "arm")


def test_the_calibration_file_is_read_only(peer: ServoPeer, driver: LerobotDriver, tmp_path: Path) -> None:
    written = json.loads((tmp_path / "arm.json").read_text())
    driver.connect()
    assert json.loads((tmp_path / "arm.json").read_text()) == written
    assert "Min_Position_Limit" not in {write for servo in peer.state().values() for write in servo["writes"]}
