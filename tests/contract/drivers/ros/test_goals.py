"""Goals of FollowJointTrajectory: results, cancellation and failures, with ROS 1 and ROS 2 behind rosbridge."""

import time
from collections.abc import Iterator

import pytest

from device_agent.drivers.ros import RosDriver
from device_agent.drivers.testing.peer import Disturbance
from device_agent.ports.driver import DriverError, UnreachableError
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.control.control_loop import ControlLoop
from device_agent.runtime.control.controller import Controller
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.load import LoadGovernor
from tests.harness.agent.controller_fixture import ignore_revocation
from tests.harness.robots.ros.peer import RosPeer
from tests.harness.robots.ros.steps import HOME, TYPE, create, until

TARGET = tuple(value + 0.05 for value in HOME)


@pytest.fixture(params=[1, 2], ids=["ros1", "ros2"])
def peer(request: pytest.FixtureRequest) -> Iterator[RosPeer]:
    peer = RosPeer(TYPE, ros=request.param, kind="goal")
    yield peer
    peer.close()


@pytest.fixture
def driver(peer: RosPeer) -> Iterator[RosDriver]:
    driver = create(peer)
    driver.connect()
    yield driver
    driver.close()
    assert peer.server.errors == []


def send_until_completed(driver: RosDriver, peer: RosPeer) -> None:
    """Command the target until the last goal has arrived."""
    until(lambda: driver.send(TARGET) and driver._commands[0]._completed == TARGET)
    until(lambda: peer.robot.action.newest == driver._goals[0]._newest)


def keep_open(peer: RosPeer) -> None:
    """Let no goal succeed."""
    peer.change(lambda robot, _: setattr(robot.action, "step", lambda: None))


def test_the_last_goal_is_settled_after_its_result(driver: RosDriver, peer: RosPeer) -> None:
    assert driver.observe().settled
    peer.change(lambda robot, _: setattr(robot.action, "silent", True))
    send_until_completed(driver, peer)
    until(lambda: peer.robot.action.succeeded)
    assert peer.joint_positions() == pytest.approx(TARGET, abs=0.01)
    assert not driver.observe().settled, "the arm is there, but the controller has reported nothing"
    commands = peer.robot.commands
    driver.send(TARGET)
    peer.wait(lambda robot, end_s=peer.robot.joints.time_s + 0.2: robot.joints.time_s > end_s)  # type: ignore[misc]
    assert peer.robot.commands == commands, "a new goal would replace the one whose result is awaited"
    ended = [(driver._goals[0]._newest, "succeeded", 0, "")]
    peer.change(lambda robot, _: robot.action.ended.extend(ended))
    until(lambda: driver.observe().settled)
    assert not driver.faults()


def test_a_motion_of_the_agent_is_done_after_the_result(driver: RosDriver, peer: RosPeer) -> None:
    controller = Controller(TYPE, LeaseGate())
    loop = ControlLoop(
        TYPE, driver, controller, name="arm", publish=lambda _: None, check_interlocks=lambda _: None,
        measure=lambda *_: None, load=LoadGovernor(),
    )  # fmt: skip
    peer.change(lambda robot, _: setattr(robot.action, "silent", True))
    loop.start()
    controller.grant(epoch=1, holder="ann", lease_s=1000, now_s=time.monotonic())
    reservation = controller.reserve(epoch=1, on_revoked=ignore_revocation)
    position_rad = dict(zip([joint.name for joint in TYPE.joints], TARGET, strict=True))
    motion = controller.start_joint_goal(reservation, position_rad, speed=1.0)
    until(lambda: peer.robot.action.succeeded)
    assert not motion.finished.wait(0.5)
    ended = [(driver._goals[0]._newest, "succeeded", 0, "")]
    peer.change(lambda robot, _: robot.action.ended.extend(ended))
    assert motion.finished.wait(60)
    assert motion.result is GoalResult.REACHED
    loop.stop()


@pytest.mark.parametrize(
    ("code", "text"), [(-4, "elbow_joint is 0.3 rad away"), (-5, "elbow_joint has not arrived"), (0, "")]
)
def test_an_aborted_goal_stops(driver: RosDriver, peer: RosPeer, code: int, text: str) -> None:
    keep_open(peer)
    send_until_completed(driver, peer)
    peer.change(lambda robot, _: robot.action.abort(code, text))
    until(driver.faults)
    (fault,) = driver.faults()
    assert (fault.code, fault.stops) == ("goal", True)
    assert f"has aborted the motion (error code {code})" in fault.message
    assert text in fault.message
    assert driver.observe().settled, "the goal has ended"
    commands = peer.robot.commands
    with pytest.raises(DriverError, match="has stopped itself"):
        driver.send(TARGET)
    assert peer.robot.commands == commands
    peer.change(lambda robot, _: robot.action.__dict__.pop("step"))
    until(lambda: not driver.faults())
    until(lambda: driver.send(HOME) and peer.joint_positions() == pytest.approx(HOME, abs=0.005))


def test_a_replaced_goal_that_met_an_obstacle_stops(driver: RosDriver, peer: RosPeer) -> None:
    driver.send(TARGET)
    first = driver._goals[0]._newest
    until(lambda: driver.send(TARGET) and driver._goals[0]._newest != first)
    peer.change(lambda robot, _: robot.action.ended.append((first, "preempted", -1, "a new goal")))
    time.sleep(0.1)
    assert not driver.faults(), "this is the usual end of a replaced goal"
    peer.change(lambda _, server: server._clients[-1].goals.add(first))
    peer.change(lambda robot, _: robot.action.ended.append((first, "aborted", -4, "obstacle")))
    until(lambda: any("obstacle" in fault.message for fault in driver.faults()))


def test_a_goal_of_another_program_stops(driver: RosDriver, peer: RosPeer) -> None:
    keep_open(peer)
    send_until_completed(driver, peer)
    time_from_start = {"secs": 0, "nsecs": 50_000_000}
    point = {"positions": list(HOME), "velocities": [0.0] * 6, "time_from_start": time_from_start}
    other = {"joint_names": peer.robot.names, "points": [point]}
    peer.change(lambda robot, _: robot.start_goal("rviz-1", {"trajectory": other}))
    until(driver.faults)
    assert "because another program sent a goal" in driver.faults()[0].message


def test_a_result_that_never_arrives_is_a_fault_and_cancels_the_goal(
    driver: RosDriver, peer: RosPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("device_agent.drivers.ros.joint_commands.OVERDUE_S", 0.2)
    keep_open(peer)
    send_until_completed(driver, peer)
    until(lambda: not driver.observe().settled)
    until(lambda: driver.observe().settled)
    assert "has reported no result; check the controller" in driver.faults()[0].message
    until(lambda: peer.robot.action.cancelled == 1)


def test_halting_without_a_position_cancels_the_goal(driver: RosDriver, peer: RosPeer) -> None:
    keep_open(peer)
    send_until_completed(driver, peer)
    peer.disturb(Disturbance.SILENCE)
    with pytest.raises(UnreachableError):
        until(lambda: driver.observe() is None)
    driver.halt()
    until(lambda: peer.robot.action.cancelled == 1)
    driver.halt()
    time.sleep(0.05)
    assert peer.robot.action.cancelled == 1


def test_a_missing_action_server_is_reported() -> None:
    first, second = RosPeer(TYPE, ros=1, kind="goal"), RosPeer(TYPE, ros=2, kind="goal")
    first.change(lambda robot, _: setattr(robot, "status", lambda: None))
    ros1 = create(first)
    with pytest.raises(UnreachableError, match="no action server at /arm_controller/follow_joint_trajectory"):
        ros1.connect()
    second.change(lambda _, server: server.actions.clear())
    ros2 = create(second)
    ros2.connect()
    until(ros2.faults)
    assert "has rejected the motion (error code 0): no action server" in ros2.faults()[0].message
    for each in (ros1, ros2, first, second):
        each.close()
