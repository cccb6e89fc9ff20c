"""What the driver for Universal Robots does in the states of its controller, at an emulated one."""

import math
import struct
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from device_agent import drivers
from device_agent.drivers.ur import modes, program, rtde
from device_agent.drivers.ur.driver import ORDER, Controller, UrDriver
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.protocol.manifests import robot_type as robot_types
from tests.harness.paths import UR5
from tests.harness.robots.universal_robots import controller as emulated
from tests.harness.robots.universal_robots.peer import UrPeer

TYPE = robot_types.load(UR5)
HOME = tuple(TYPE.home_rad[name] for name in ORDER)
REST_S = 0.35
WAIT_S = 60.0


@pytest.fixture
def peer() -> Iterator[UrPeer]:
    peer = UrPeer(TYPE)
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: UrPeer) -> Iterator[UrDriver]:
    driver = UrDriver(TYPE, UR5, Controller("127.0.0.1", peer.rtde_port, peer.script_port, 125.0), "arm")
    yield driver
    driver.close()


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)


def reconnect(driver: UrDriver) -> None:
    def connects() -> bool:
        try:
            driver.connect()
        except UnreachableError:
            return False
        return True

    until(connects)


def move_fast(driver: UrDriver, peer: UrPeer, *, direction: float = 1.0) -> None:
    """Send a setpoint 1 rad away for all joints, until the arm moves at 3 rad/s. It would move on for 0.2 s."""
    target = [value + direction for value in peer.joint_positions()]

    def moves() -> bool:
        driver.send(target)
        return max(map(abs, peer.joint_velocities())) > 3.0

    until(moves)


def codes(driver: UrDriver) -> list[str]:
    return [fault.code for fault in driver.faults() if fault.stops]


# ------------------------------------------------------------ versions and recipes


def test_a_controller_without_protocol_version_2_ends_the_agent_with_a_reason(driver: UrDriver, peer: UrPeer) -> None:
    peer.rtde.versions = {1}
    with pytest.raises(DriverError, match="does not support RTDE version 2; update its software") as caught:
        driver.connect()
    assert not isinstance(caught.value, UnreachableError), "it cannot recover"


@pytest.mark.parametrize("name", ["target_moment", "output_int_register_24", "input_double_register_29"])
def test_a_missing_variable_is_named(driver: UrDriver, peer: UrPeer, name: str) -> None:
    peer.rtde.missing = {name}
    with pytest.raises(DriverError, match=f"does not have the variable '{name}'") as caught:
        driver.connect()
    assert not isinstance(caught.value, UnreachableError)


@pytest.mark.parametrize("name", ["input_int_register_24", "input_int_register_26"])
def test_registers_of_another_client_are_a_temporary_fault(driver: UrDriver, peer: UrPeer, name: str) -> None:
    peer.rtde.taken = {name}
    with pytest.raises(UnreachableError, match=f"another program writes '{name}'"):
        driver.connect()
    peer.rtde.taken = set()
    driver.connect()
    driver.observe()


def test_a_port_of_another_service_is_reported(peer: UrPeer) -> None:
    wrong = UrDriver(TYPE, UR5, Controller("127.0.0.1", peer.script_port, peer.script_port, 125.0), "arm")
    with pytest.raises(UnreachableError, match="is it an RTDE port"):
        wrong.connect()


# ------------------------------------------------------------ programs


def test_a_controller_in_local_mode_is_unreachable(driver: UrDriver, peer: UrPeer) -> None:
    peer.controller.remote = False
    with pytest.raises(UnreachableError, match="remote control"):
        driver.connect()
    with pytest.raises(UnreachableError):
        driver.observe()
    peer.controller.remote = True
    driver.connect()
    driver.observe()


def test_a_program_that_was_ended_at_the_robot_is_not_started_again(driver: UrDriver, peer: UrPeer) -> None:
    driver.connect()
    started = peer.controller.started_programs
    peer.change(emulated.Controller.end_program)
    until(lambda: codes(driver) == ["program-ended"])
    with pytest.raises(DriverError, match="was ended at the robot"):
        driver.send(driver.observe().position_rad)
    stopped_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > stopped_s + 1.0)
    assert peer.controller.started_programs == started
    driver.connect()
    assert not codes(driver)


def test_a_paused_program_continues_without_a_motion(driver: UrDriver, peer: UrPeer) -> None:
    driver.connect()
    move_fast(driver, peer)
    peer.change(emulated.Controller.pause_program)
    until(lambda: codes(driver) == ["program-paused"])
    with pytest.raises(DriverError, match="continue it there"):
        driver.send(HOME)
    peer.wait(lambda controller: controller.at_rest)
    before = peer.joint_positions()
    peer.change(emulated.Controller.continue_program)
    until(lambda: not codes(driver))
    continued_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > continued_s + 0.5)
    assert peer.joint_positions() == pytest.approx(before, abs=0.02)


def test_two_sessions_do_not_move_each_others_program(driver: UrDriver, peer: UrPeer) -> None:
    driver.connect()
    connection = driver._connection
    assert connection is not None
    other = UrDriver(TYPE, UR5, Controller("127.0.0.1", peer.rtde_port, peer.script_port, 125.0), "other")
    other.connect()
    until(lambda: codes(driver) == ["program-ended"])
    with pytest.raises(DriverError):
        driver.send([value + 0.1 for value in HOME])
    for _ in range(20):
        connection.command([value + 0.1 for value in HOME])
    sent_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > sent_s + 0.3)
    assert peer.joint_positions() == pytest.approx(HOME)
    other.close()


def test_halting_ends_the_program_also_for_delayed_setpoints(driver: UrDriver, peer: UrPeer) -> None:
    driver.connect()
    connection = driver._connection
    assert connection is not None
    move_fast(driver, peer)
    driver.halt()
    for _ in range(20):
        connection.command([value + 1.0 for value in HOME])  # of a thread that passed its checks before the halt
    halted_s = peer.controller.time_s
    rest_s = peer.wait(lambda controller: controller.at_rest)
    assert rest_s - halted_s < REST_S
    peer.wait(lambda controller: controller.runtime_state == emulated.STOPPED)
    ended_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > ended_s + 0.3)
    assert peer.controller.at_rest
    assert not codes(driver), "the agent's own halt does not latch Stop"


def test_setpoints_are_approached_at_the_maximum_velocity(driver: UrDriver, peer: UrPeer) -> None:
    driver.connect()
    fastest = 0.0
    target = [HOME[0] + 1.5, *HOME[1:]]

    def arrives() -> bool:
        nonlocal fastest
        driver.send(target)
        fastest = max(fastest, *map(abs, peer.joint_velocities()))
        return math.isclose(peer.joint_positions()[0], target[0], abs_tol=0.01)

    until(arrives)
    assert 0.5 < fastest <= TYPE.joints[0].max_velocity_rad_s * 1.01


def test_a_step_after_rest_is_approached_with_a_ramp(driver: UrDriver, peer: UrPeer) -> None:
    speeds: list[tuple[float, float]] = []
    peer.controller.each_cycle = lambda controller: speeds.append((controller.time_s, max(controller.velocity)))
    driver.connect()
    target = [HOME[0] + 0.5, *HOME[1:]]

    def arrives() -> bool:
        driver.send(target)
        return math.isclose(peer.joint_positions()[0], target[0], abs_tol=0.01)

    until(arrives)
    start_s = next(time_s for time_s, speed in speeds if speed > 0)
    ramp_rad_s2 = 2 * TYPE.joints[0].max_acceleration_rad_s2
    early = [(time_s - start_s, speed) for time_s, speed in speeds if 0 < time_s - start_s < 0.1]
    assert early
    assert all(speed <= ramp_rad_s2 * (elapsed_s + emulated.CYCLE_S) for elapsed_s, speed in early)


def test_joints_are_matched_by_name() -> None:
    order = [5, 0, 3, 1, 4, 2]
    mixed = replace_joints(order)
    peer = UrPeer(mixed)
    driver = UrDriver(mixed, UR5, Controller("127.0.0.1", peer.rtde_port, peer.script_port, 125.0), "arm")
    try:
        driver.connect()
        assert driver.observe().position_rad == pytest.approx([HOME[index] for index in order])
        target = tuple(HOME[index] + 0.02 * place for place, index in enumerate(order))

        def arrives() -> bool:
            driver.send(target)
            expected = [HOME[index] + 0.02 * order.index(index) for index in range(6)]
            return peer.controller.position == pytest.approx(expected, abs=0.005)

        until(arrives)
        health = driver.report("health")
        assert health["temperature_c.wrist_3"] == 35.0
        assert health["load.wrist_3"] == round(1 / 28, 3)
        assert driver.report("odometry") == {}
    finally:
        driver.close()
        peer.close()


def replace_joints(order: list[int]) -> robot_types.RobotType:
    by_name = {joint.name: joint for joint in TYPE.joints}
    return msgspec.structs.replace(TYPE, joints=tuple(by_name[ORDER[index]] for index in order))


# ------------------------------------------------------------ safety


@pytest.mark.parametrize(
    ("safety_mode", "robot_mode", "code"),
    [
        (1, 7, None),
        (2, 7, None),
        (3, 7, "protective-stop"),
        (4, 7, "recovery-mode"),
        (5, 7, "safeguard-stop"),
        (6, 5, "emergency-stop"),
        (7, 5, "emergency-stop"),
        (8, 3, "safety-violation"),
        (9, 3, "safety-fault"),
        (10, 7, "validate-joint"),
        (11, 7, "safety-unknown"),
        (12, 7, "safeguard-stop"),
        (13, 7, "enabling-stop"),
        (14, 7, "safety-unknown"),
        (0, 7, "safety-unknown"),
        (-1, 7, "safety-unknown"),
        *((1, mode, "not-running") for mode in (-1, 0, 1, 2, 3, 4, 5, 6, 8, 9)),
    ],
)
def test_modes_are_faults(safety_mode: int, robot_mode: int, code: str | None) -> None:
    fault = modes.fault(safety_mode, robot_mode)
    assert (None if fault is None else fault.code) == code
    assert fault is None or (fault.stops and fault.message)


@pytest.mark.parametrize("mode", [emulated.PROTECTIVE_STOP, emulated.EMERGENCY_STOP])
def test_a_stop_of_the_robot_ends_the_motion_and_nothing_follows_its_release(
    driver: UrDriver, peer: UrPeer, mode: int
) -> None:
    driver.connect()
    move_fast(driver, peer)
    peer.change(lambda controller: controller.set_safety_mode(mode))
    until(lambda: codes(driver))
    peer.wait(lambda controller: controller.at_rest)
    before = peer.joint_positions()
    peer.change(lambda controller: controller.set_safety_mode(emulated.NORMAL))
    until(lambda: not codes(driver))
    released_s = peer.controller.time_s
    peer.wait(lambda controller: controller.time_s > released_s + 0.5)
    assert peer.joint_positions() == pytest.approx(before, abs=1e-3)
    move_fast(driver, peer, direction=-1.0)


def test_an_arm_that_is_switched_off_connects_and_starts_later(driver: UrDriver, peer: UrPeer) -> None:
    peer.controller.robot_mode = emulated.POWERED_OFF
    driver.connect()
    assert codes(driver) == ["not-running"]
    peer.change(lambda controller: setattr(controller, "robot_mode", emulated.RUNNING))
    until(lambda: not codes(driver))
    move_fast(driver, peer)


# ------------------------------------------------------------ lost connections


@pytest.mark.parametrize("cuts", [5, pytest.param(200, marks=pytest.mark.long)])
def test_a_cut_connection_ends_each_motion_in_time(driver: UrDriver, peer: UrPeer, cuts: int) -> None:
    times = []
    for number in range(cuts):
        reconnect(driver)
        move_fast(driver, peer, direction=(-1.0) ** number)
        cut_s = peer.cut()
        times.append(peer.wait(lambda controller: controller.at_rest) - cut_s)
        before = peer.joint_positions()
        peer.restore()
        reconnect(driver)
        assert peer.joint_positions() == pytest.approx(before, abs=1e-3)
    assert max(times) <= REST_S, f"longest {max(times):.3f} s"


# ------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "option 'address' of driver 'ur' must be the host name"),
        ({"address": "arm", "speed": 1}, "driver 'ur' has no option 'speed'; it has: address, frequency"),
        ({"address": "arm", "frequency": 501}, "'frequency' .* from 1 to 500, not 501"),
        ({"address": "arm", "rtde_port": "30004"}, "'rtde_port' .* from 1 to 65535"),
        ({"address": "arm", "script_port": True}, "'script_port' .* from 1 to 65535"),
    ],
)
def test_wrong_options_are_rejected(options: dict[str, object], message: str) -> None:
    with pytest.raises(DriverError, match=message):
        drivers.load("ur")(TYPE, UR5, options, "arm")


def test_other_robot_types_are_rejected() -> None:
    nao = robot_types.load(UR5.parent / "nao")
    with pytest.raises(DriverError, match="must have the joints shoulder_pan"):
        drivers.load("ur")(nao, UR5, {"address": "arm"}, "arm")


# ------------------------------------------------------------ bytes


def test_packages_are_split_and_impossible_headers_are_discarded() -> None:
    first, second = rtde.package(rtde.Package.DATA, b"\x01ab"), rtde.package(rtde.Package.TEXT_MESSAGE, b"hello")
    stream = first + second
    for cut in range(len(stream)):
        buffer = bytearray()
        found: list[tuple[int, bytes]] = []
        for part in (stream[:cut], stream[cut:]):
            buffer += part
            found += rtde.split(buffer)
        assert found == [(rtde.Package.DATA, b"\x01ab"), (rtde.Package.TEXT_MESSAGE, b"hello")]
    for header in (struct.pack(">HB", 2, ord("U")), struct.pack(">HB", 5000, ord("U")), struct.pack(">HB", 9, 0)):
        buffer = bytearray(header + b"rest")
        assert not list(rtde.split(buffer))
        assert not buffer


def test_the_program_contains_its_session_and_limits() -> None:
    text = program.script(7, max_velocity_rad_s=[1, 2, 3, 4, 5, 6], max_acceleration_rad_s2=[4] * 6, braking_rad_s2=21)
    assert "session = 7\n" in text
    assert "limit = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]\n" in text
    assert "ramp = [8.0, 8.0, 8.0, 8.0, 8.0, 8.0]\n" in text
    assert text.count("stopj(21.0)") == 2
    assert text.isascii()
    assert max(map(len, text.splitlines())) < 100
