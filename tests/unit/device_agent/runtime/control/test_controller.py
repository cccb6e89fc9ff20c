"""Controller: setpoints, leases, Stop and actions, period by period."""

import pytest

from device_agent.protocol import Mode, StopLatch
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, ignore_revocation, interruptions, leased, refuses


def test_streamed_setpoints_move_the_device_to_the_target_and_keep_the_lease() -> None:
    fixture = leased()
    assert fixture.stream(1, 3.5) is Mode.STREAMING
    assert fixture.elbow == pytest.approx(2.0, abs=1e-4)
    assert 1.0 < max(fixture.velocities) <= 0.35 * 3.0 + 1e-6, "the streaming share of the velocity limit"
    assert fixture.run(1.0) is Mode.IDLE
    lease = fixture.controller.lease(fixture.now_s)
    assert lease is not None
    assert lease.epoch == 1


def test_after_the_watchdog_nothing_moves_until_control_is_taken_again() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    assert fixture.controller.moving
    assert fixture.at_rest_after(1.0) <= 0.35
    assert fixture.controller.mode is Mode.HOLDING
    with refuses("no_lease"):
        fixture.offer(1)
    with pytest.raises(Refused):
        fixture.take(1)
    rest = fixture.elbow
    fixture.run(1.0)
    assert fixture.elbow == rest
    fixture.take(2)
    fixture.stream(2, 0.5)
    assert fixture.elbow > rest


@pytest.mark.parametrize("age_ms", [201, 5_000, -1])
def test_a_setpoint_with_an_old_or_future_echo_is_rejected(age_ms: int) -> None:
    fixture = leased()
    with refuses("too_old"):
        fixture.offer(1, age_ms=age_ms)
    fixture.run(0.2)
    assert fixture.elbow == 0.0


def test_an_older_setpoint_that_arrives_late_is_dropped() -> None:
    fixture = leased()
    fixture.offer(1, sequence=7)
    with refuses("out_of_order"):
        fixture.offer(1, sequence=7)


def test_a_setpoint_beyond_the_range_is_clamped_and_reported() -> None:
    fixture = leased()
    fixture.offer(1, elbow=9.0)
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ("elbow: range",)
    fixture.stream(1, 6.0, elbow=9.0)
    assert fixture.elbow == pytest.approx(3.0, abs=1e-3)


def test_a_newer_lease_fences_the_older() -> None:
    fixture = leased()
    fixture.stream(1, 0.5)
    fixture.take(2)
    with pytest.raises(Refused):
        fixture.offer(1)
    with refuses("stale_epoch"):
        fixture.take(1)
    assert fixture.at_rest_after(0.5) < 0.2
    lease = fixture.controller.lease(fixture.now_s)
    assert lease is not None
    assert lease.epoch == 2


def test_a_lease_that_expires_in_motion_holds() -> None:
    fixture = ControllerFixture()
    fixture.take(1, lease_s=0.5)
    fixture.stream(1, 0.48)
    fixture.run(0.3)
    assert not fixture.controller.moving
    assert fixture.controller.mode is Mode.HOLDING
    with pytest.raises(Refused):
        fixture.offer(1)


def test_stop_latches_and_reset_resumes_nothing() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    for caller in ("bob", "eve"):
        fixture.controller.stop(StopLatch(caller=caller, reason="", at_ms=1))
    assert fixture.controller.latch == StopLatch(caller="bob", reason="", at_ms=1), "the first one is shown"
    assert fixture.at_rest_after(0.5) < 0.2
    assert fixture.controller.mode is Mode.STOPPED
    fixture.take(2)
    with refuses("stopped"):
        fixture.offer(2)
    rest = fixture.elbow
    fixture.controller.reset_stop(epoch=3)
    fixture.run(0.5)
    assert fixture.elbow == pytest.approx(rest, abs=1e-9)
    with refuses("no_lease"):
        fixture.offer(2)
    fixture.take(4)
    fixture.stream(4, 0.5)
    assert fixture.elbow != rest


def test_a_repeated_or_late_reset_does_not_release_a_later_stop() -> None:
    fixture = leased()
    fixture.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
    fixture.controller.reset_stop(epoch=3)
    fixture.controller.stop(StopLatch(caller="eve", reason="", at_ms=2))
    for epoch, code in ((3, "lease_ended"), (2, "stale_epoch"), (0, "stale_epoch")):
        with pytest.raises(Refused) as refused:
            fixture.controller.reset_stop(epoch=epoch)
        assert refused.value.code == code
    assert fixture.controller.latch is not None
    fixture.controller.reset_stop(epoch=4)
    assert fixture.controller.latch is None


def test_commands_from_before_a_reset_are_rejected() -> None:
    fixture = leased()
    fixture.controller.stop(StopLatch(caller="bob", reason="", at_ms=1))
    fixture.controller.reset_stop(epoch=3)
    for epoch in (1, 2, 3):
        with pytest.raises(Refused) as refused:
            fixture.controller.reserve(epoch=epoch, on_revoked=lambda _: None)
        assert refused.value.code in {"stale_epoch", "lease_ended"}
        with pytest.raises(Refused):
            fixture.take(epoch)


def test_a_joint_goal_is_reached() -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 1.0}, speed=1.0)
    fixture.run(2.0)
    assert move.result is GoalResult.REACHED
    assert fixture.elbow == pytest.approx(1.0, abs=1e-4)
    fixture.controller.end_reservation(reservation)
    assert fixture.run(0.1) is Mode.IDLE


@pytest.mark.parametrize(("position_rad", "code"), [({"elbow": 3.1}, "out_of_range"), ({"knee": 0.0}, "unknown_joint")])
def test_an_invalid_goal_is_rejected_completely(position_rad: dict[str, float], code: str) -> None:
    fixture = ControllerFixture()
    reservation = fixture.reserve()
    with pytest.raises(Refused) as refused:
        fixture.controller.start_joint_goal(reservation, {"shoulder": 1.0} | position_rad, speed=1.0)
    assert refused.value.code == code
    fixture.run(0.5)
    assert not fixture.controller.moving


@pytest.mark.parametrize("cause", interruptions())
def test_a_revoked_action_cannot_move_the_device(cause: str) -> None:
    fixture = ControllerFixture()
    why: list[Refused] = []
    fixture.take(1, lease_s=5.0)
    reservation = fixture.controller.reserve(epoch=1, on_revoked=why.append)
    move = fixture.controller.start_joint_goal(reservation, {"elbow": 2.9}, speed=0.1)
    fixture.run(0.5)
    interruptions()[cause](fixture)  # type: ignore[operator]
    fixture.run(0.3)
    assert move.result is GoalResult.INTERRUPTED
    assert len(why) == 1
    assert not fixture.controller.moving
    with pytest.raises(Refused):
        fixture.controller.start_joint_goal(reservation, {"elbow": -1.0}, speed=1.0)


def test_setpoints_are_rejected_while_an_action_runs() -> None:
    fixture = leased()
    reservation = fixture.reserve()
    with refuses("busy"):
        fixture.offer(1)
    with pytest.raises(Refused):
        fixture.controller.reserve(epoch=1, on_revoked=ignore_revocation)
    fixture.controller.end_reservation(reservation)
    fixture.offer(1)


def test_losing_the_link_at_rest_keeps_the_lease() -> None:
    fixture = leased()
    fixture.controller.interrupt(Refused("link_lost", ""))
    assert fixture.controller.lease(fixture.now_s) is not None


def test_repeated_faults_are_one_fault_and_recovery_needs_a_fault() -> None:
    fixture = ControllerFixture()
    fixture.controller.clear_fault([1.0, 1.0])
    fixture.run(PERIOD_S)
    assert fixture.elbow == 0.0, "a device that is well stays where it is"
    fixture.controller.set_fault("no answer")
    fixture.controller.set_fault("no answer")
    assert fixture.run(PERIOD_S) is Mode.FAULT
    fixture.controller.clear_fault([1.0, 1.0])
    assert fixture.run(PERIOD_S) is Mode.IDLE
    assert fixture.elbow == 1.0
