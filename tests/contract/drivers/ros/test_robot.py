"""What the driver for ROS does with the messages and failures of a robot, at an emulated rosbridge server."""

import contextlib
import math
import socket
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest

from device_agent.drivers.ros import RosBaseDriver, RosDriver
from device_agent.drivers.testing.peer import Disturbance
from device_agent.middleware.ros.connection import Publication
from device_agent.middleware.ros.rosbridge import RosbridgeChannel
from device_agent.ports.driver import DriverError, Twist, UnreachableError
from tests.harness.robots.ros import robot as topics
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.steps import HOME, TYPE, create, until

REST_S = 0.35


def reconnect(driver: RosDriver) -> None:
    def connects() -> bool:
        try:
            driver.connect()
        except UnreachableError:
            return False
        return True

    until(connects)


def move_fast(driver: RosDriver, peer: RosPeer, *, direction: float = 1.0) -> None:
    """Send a setpoint 1 rad away for all joints, until the arm moves at 2.5 rad/s."""
    target = [value + direction for value in peer.joint_positions()]

    def moves() -> bool:
        driver.send(target)
        return max(map(abs, peer.joint_velocities())) > 2.5

    until(moves)


def corrupt(peer: RosPeer, change: Callable[[dict[str, Any]], None]) -> None:
    """Change all further JointState messages of the robot."""
    original = peer.robot.joint_state

    def changed(stamp_ns: int, names: list[str]) -> dict[str, Any]:
        message = original(stamp_ns, names)
        change(message)
        return message

    peer.change(lambda robot, _: setattr(robot, "joint_state", changed))


# ------------------------------------------------------------ joints


def test_effort_that_is_not_measured_is_zero(driver: RosDriver) -> None:
    driver.connect()
    assert driver.observe().effort_nm == (0.0,) * 6


def test_velocities_that_are_not_measured_are_differences(driver: RosDriver, peer: RosPeer) -> None:
    corrupt(peer, lambda message: message.update(velocity=[]))
    driver.connect()
    move_fast(driver, peer)
    until(lambda: driver.send([value + 1.0 for value in HOME]) and max(driver.observe().velocity_rad_s) > 1.0)


def test_a_missing_joint_is_named(driver: RosDriver, peer: RosPeer) -> None:
    def leave_out(message: dict[str, Any]) -> None:
        for field in ("name", "position", "velocity", "effort"):
            del message[field][3]

    driver.connect()
    corrupt(peer, leave_out)
    with pytest.raises(UnreachableError, match=r"/joint_states has no new values of the joints elbow_joint$"):
        until(lambda: driver.observe() is None)
    with pytest.raises(UnreachableError, match="elbow_joint"):
        driver.send(HOME)
    with pytest.raises(UnreachableError, match="elbow_joint"):
        driver.connect()


def test_joints_of_several_publishers_are_merged(driver: RosDriver, peer: RosPeer) -> None:
    parts = [("shoulder_pan_joint", "elbow_joint"), ("shoulder_lift_joint", "wrist_1_joint", "wrist_2_joint"), ()]
    count = 0

    def split(message: dict[str, Any]) -> None:
        nonlocal count
        count += 1
        names = parts[count % 3] or ("wrist_3_joint",)
        rows = zip(message["name"], message["position"], message["velocity"], message["effort"], strict=True)
        columns = list(zip(*[row for row in rows if row[0] in names], strict=True))
        message.update(zip(("name", "position", "velocity", "effort"), map(list, columns), strict=True))

    corrupt(peer, split)
    driver.connect()
    target = [value + 0.1 for value in HOME]

    def arrives() -> bool:
        driver.send(target)
        return driver.observe().position_rad == pytest.approx(target, abs=0.01)

    until(arrives)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda message: message["position"].__setitem__(2, math.nan), r"Expected `float`, got `null`"),
        (lambda message: message["position"].pop(), "fewer values than names"),
        (lambda message: message["velocity"].pop(), "fewer values than names"),
        (lambda message: message.update(name=["elbow_joint"] * 7), "names a joint twice"),
        (lambda message: message["header"].update(stamp={"secs": 0, "nsecs": 0}), "has no timestamp"),
        (lambda message: message["header"].update(stamp={"secs": 5, "nsecs": 1}), "do not increase"),
        (lambda message: message.pop("header"), "missing required field `header`"),
        (lambda message: message.update(position="1, 2"), "Expected `array`, got `str`"),
    ],
)
def test_invalid_messages_are_rejected_with_a_reason(
    driver: RosDriver, peer: RosPeer, change: Callable[[dict[str, Any]], None], reason: str
) -> None:
    driver.connect()
    before = driver.observe()
    corrupt(peer, change)
    with pytest.raises(UnreachableError, match=reason):
        until(lambda: driver.observe().at_s is None)
    peer.change(lambda robot, _: robot.__dict__.pop("joint_state"))
    reconnect(driver)
    assert driver.observe().position_rad == pytest.approx(before.position_rad, abs=0.01)


def test_measurements_that_arrive_late_are_rejected(peer: RosPeer) -> None:
    real, simulated = create(peer), create(peer, simulated=True)
    assert (real.simulated, simulated.simulated) == (False, True)
    real.connect()
    simulated.connect()
    behind_ns = 0

    def delay(message: dict[str, Any]) -> None:
        nonlocal behind_ns
        behind_ns += 4_000_000  # of 5 ms: the timestamps still increase
        stamp = message["header"]["stamp"]
        total_ns = stamp["secs"] * 10**9 + stamp["nsecs"] - behind_ns
        stamp["secs"], stamp["nsecs"] = divmod(total_ns, 10**9)

    corrupt(peer, delay)
    with pytest.raises(UnreachableError, match=r"1\.\d s late"):
        until(lambda: real.observe().at_s is None)
    simulated.observe()
    real.close()
    simulated.close()


# ------------------------------------------------------------ commands


@pytest.mark.parametrize("kind", ["trajectory", "positions", "joint_state", "goal"])
@pytest.mark.parametrize("ros", [1, 2])
def test_each_kind_of_command_moves_the_arm(kind: str, ros: int) -> None:
    peer = RosPeer(TYPE, ros=ros, kind=kind)
    driver = create(peer)
    driver.connect()
    target = [value + 0.03 * (index + 1) for index, value in enumerate(HOME)]

    def arrives() -> bool:
        driver.send(target)
        return peer.joint_positions() == pytest.approx(target, abs=0.002)

    until(arrives)
    driver.close()
    peer.close()
    assert (peer.server.errors, peer.robot.rejected) == ([], [])


def test_commands_are_published_at_the_configured_rate(peer: RosPeer) -> None:
    driver = create(peer, command={"topic": topics.COMMAND, "rate_hz": 20})
    driver.connect()
    begin, count, end_s = peer.robot.commands, 0, time.monotonic() + 0.5
    while time.monotonic() < end_s:
        driver.send(HOME)
        count += 1
        time.sleep(0.001)
    driver.close()
    assert peer.robot.commands - begin <= 0.5 * 20 / 0.75 + 2
    assert count > 20


def test_speed_and_acceleration_after_rest_are_limited(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()
    places: list[tuple[float, float]] = []
    original = peer.robot.step

    def step() -> None:
        original()
        places.append((time.monotonic(), peer.robot.joints.position[peer.robot.names[0]]))

    peer.change(lambda robot, _: setattr(robot, "step", step))
    target = [HOME[0] + 1.5, *HOME[1:]]

    def arrives() -> bool:
        driver.send(target)
        return math.isclose(peer.joint_positions()[0], target[0], abs_tol=0.01)

    until(arrives)
    # The driver limits by the machine's clock. On a busy machine the robot's clock is slower.
    fastest = max(speed for _, speed in speeds(places, over_s=0.1))
    assert 1.0 < fastest < 1.3 * TYPE.joints[0].max_velocity_rad_s
    start_s = next(time_s for time_s, position in places if position > HOME[0] + 1e-3)
    assert max(speed for time_s, speed in speeds(places, over_s=0.02) if time_s < start_s + 0.03) < 1.5


def speeds(places: Sequence[tuple[float, float]], over_s: float) -> Iterator[tuple[float, float]]:
    """Times [s] and mean speeds over at least ``over_s`` before them [rad/s]."""
    first = 0
    for time_s, position in places:
        while places[first + 1][0] <= time_s - over_s:
            first += 1
        if places[first][0] <= time_s - over_s:
            yield time_s, (position - places[first][1]) / (time_s - places[first][0])


def wait_for_rest(peer: RosPeer) -> tuple[float, tuple[float, ...]]:
    """Wait for rest that lasts; returns its start on the robot's clock [s] and the positions then [rad].

    A joint that turns back is at rest for one cycle.
    """
    rest: list[tuple[float, tuple[float, ...]]] = []

    def rests(robot: topics.Robot) -> bool:
        joints = robot.joints
        positions = tuple(joints.position[name] for name in robot.names)
        if not joints.at_rest:
            rest.clear()
        elif not rest or positions != pytest.approx(rest[0][1], abs=1e-4):
            rest[:] = [(joints.time_s, positions)]
        return bool(rest) and joints.time_s > rest[0][0] + 0.1

    peer.wait(rests)
    return rest[0]


def test_halting_brakes_also_for_delayed_commands(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()
    move_fast(driver, peer)
    connection = driver._connection
    assert connection is not None
    publish, target = connection.publish, [value + 2.0 for value in peer.joint_positions()]

    braking: list[Any] = []

    def brake(publication: Any) -> None:
        braking.append(publication)
        publish(publication)

    def halted_meanwhile(publication: Any) -> None:
        connection.publish = brake  # type: ignore[method-assign, assignment]
        driver.halt()  # of the supervisor, while this thread sends
        publish(publication)

    connection.publish = halted_meanwhile  # type: ignore[method-assign, assignment]
    halted_s = peer.robot.joints.time_s
    with pytest.raises(DriverError, match="was halted"):
        until(lambda: not driver.send(target))
    assert len(braking) == 2, "the second follows the delayed command"
    rest_s, before = wait_for_rest(peer)
    assert rest_s - halted_s < REST_S
    peer.wait(lambda robot: robot.joints.time_s > rest_s + 0.4)
    assert peer.joint_positions() == pytest.approx(before, abs=1e-3)


def test_an_outdated_position_is_not_held(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()
    peer.disturb(Disturbance.SILENCE)
    with pytest.raises(UnreachableError):
        until(lambda: driver.observe() is None)
    commands = peer.robot.commands
    driver.halt()
    peer.wait(lambda robot, end_s=peer.robot.joints.time_s + 0.2: robot.joints.time_s > end_s)  # type: ignore[misc]
    assert peer.robot.commands == commands


# ------------------------------------------------------------ connections


@pytest.mark.parametrize("cuts", [5, pytest.param(200, marks=pytest.mark.long)])
def test_a_cut_connection_ends_each_motion_in_time(driver: RosDriver, peer: RosPeer, cuts: int) -> None:
    times = []
    for number in range(cuts):
        reconnect(driver)
        move_fast(driver, peer, direction=(-1.0) ** number)
        cut_s = peer.cut()
        times.append(peer.wait(lambda robot: robot.joints.at_rest) - cut_s)
        before = peer.joint_positions()
        peer.restore()
        reconnect(driver)
        assert peer.joint_positions() == pytest.approx(before, abs=1e-3)
    assert max(times) <= REST_S, f"longest {max(times):.3f} s, median {statistics.median(times):.3f} s"


def test_a_base_without_a_connection_stops_by_its_own_timeout(mobile: tuple[RosBaseDriver, RosPeer]) -> None:
    driver, peer = mobile
    home = driver.observe().position_rad

    def drives() -> bool:
        driver.send(home)
        driver.drive(Twist(0.3))
        return peer.base_twist().forward_m_s > 0.29

    until(drives)
    cut_s = peer.cut()
    rest_s = peer.wait(lambda robot: robot.base.forward_m_s == 0.0)
    assert rest_s - cut_s <= REST_S + 0.05
    with pytest.raises(UnreachableError):
        until(lambda: not driver.drive(Twist(0.3)))


def test_bytes_that_are_no_frames_end_the_connection(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()
    peer.change(lambda _, server: server.send_bytes(b"\xff\xff\xff\xff garbage"))
    with pytest.raises(UnreachableError, match="is lost"):
        until(lambda: driver.observe() is None)
    driver.connect()


def test_a_robot_that_does_not_receive_is_lost(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()
    connection = driver._connection
    assert connection is not None
    large = Publication(topics.COMMAND, {"name": "x" * 100_000})
    with peer._lock, pytest.raises(UnreachableError, match="is lost: "):
        until(lambda: connection.publish(large))
    with pytest.raises(UnreachableError, match="is lost"):
        driver.send(HOME)


def test_a_closed_connection_delivers_nothing_later(peer: RosPeer) -> None:
    channel = RosbridgeChannel(f"127.0.0.1:{peer.server.port}")
    until(lambda: peer.server._clients)
    sent = 0
    with peer._lock:  # the robot's computer receives nothing
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while True:
                channel.send(b"x" * 10_000)
                sent += 10_000
        channel.close()
        client, received = peer.server._clients[0]._socket, 0
        with contextlib.suppress(ConnectionResetError):
            while data := client.recv(65536):
                received += len(data)
    assert received < sent


def test_the_last_command_before_a_close_is_delivered(driver: RosDriver, peer: RosPeer) -> None:
    driver.connect()  # with a command to hold
    driver.halt()
    driver.close()
    peer.wait(lambda robot: robot.commands == 2)


def test_rejections_of_rosbridge_are_reported(peer: RosPeer) -> None:
    driver = create(peer, joint_states=topics.ODOMETRY)
    with pytest.raises(UnreachableError, match=r"ROS reports: .*/odom has the type"):
        driver.connect()


def test_a_port_of_another_service_is_reported(peer: RosPeer) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        driver = create(peer, address=f"127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(UnreachableError, match="is no rosbridge server"):
            driver.connect()
