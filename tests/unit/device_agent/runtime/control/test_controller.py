"""Controller: setpoints, leases, Stop, actions and interlocks, period by period."""

import math

import pytest

from device_agent.protocol import Mode, StopLatch
from device_agent.runtime.authority.speed_restrictions import Restriction, Restrictions
from device_agent.runtime.control.goals import GoalResult
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, interruptions, leased, refuses

PERSON = "a person is there"


def test_streamed_setpoints_move_the_device_to_the_target_and_keep_the_lease() -> None:
    fixture = leased()
    assert fixture.stream(1, 3.5) is Mode.STREAMING
    assert fixture.elbow == pytest.approx(2.0, abs=1e-4)
    assert 1.0 < max(fixture.velocities) <= 0.35 * 3.0 + 1e-6, "the streaming share of the velocity limit"
    assert fixture.run(1.0) is Mode.IDLE
    assert fixture.lease_epoch == 1
    fixture.controller.interrupt(Refused("link_lost", ""))
    assert fixture.lease_epoch == 1, "a lost link at rest"


def test_after_the_watchdog_nothing_moves_until_control_is_taken_again() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    assert fixture.controller.moving
    assert fixture.at_rest_after(1.0) <= 0.35
    assert fixture.controller.mode is Mode.HOLDING
    with refuses("no_lease"):
        fixture.offer(1)
    with pytest.raises(Refused):
        fixture.grant(1)
    rest = fixture.elbow
    fixture.run(1.0)
    assert fixture.elbow == rest
    fixture.grant(2)
    fixture.stream(2, 0.5)
    assert fixture.elbow > rest


def test_old_and_overtaken_setpoints_are_rejected() -> None:
    fixture = leased()
    for age_ms in (201, 5_000, -1):
        with refuses("too_old"):
            fixture.offer(1, age_ms=age_ms)
    fixture.run(0.2)
    assert fixture.elbow == 0.0
    fixture.offer(1, sequence=7)
    with refuses("out_of_order"):
        fixture.offer(1, sequence=7)


def test_a_setpoint_beyond_the_range_is_clamped_and_reported() -> None:
    fixture = leased()
    fixture.offer(1, 9.0)
    assert fixture.controller.update(fixture.now_s + PERIOD_S).limited == ("elbow: range",)
    fixture.stream(1, 6.0, elbow=9.0)
    assert fixture.elbow == pytest.approx(3.0, abs=1e-3)


def test_a_newer_lease_fences_the_older() -> None:
    fixture = leased()
    fixture.stream(1, 0.5)
    fixture.grant(2)
    with refuses("no_lease"):
        fixture.offer(1)
    with refuses("stale_epoch"):
        fixture.grant(1)
    assert fixture.at_rest_after(0.5) < 0.2
    assert fixture.lease_epoch == 2


def test_a_lease_that_expires_in_motion_holds() -> None:
    fixture = ControllerFixture()
    fixture.grant(1, lease_s=0.5)
    fixture.stream(1, 0.48)
    assert fixture.run(0.3) is Mode.HOLDING
    assert not fixture.controller.moving
    with refuses("no_lease"):
        fixture.offer(1)


def test_stop_latches_and_reset_resumes_nothing() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    for caller in ("bob", "eve"):
        fixture.stop(caller)
    assert fixture.controller.latch == StopLatch(caller="bob", reason="", at_ms=1), "the first one is shown"
    assert fixture.at_rest_after(0.5) < 0.2
    assert fixture.controller.mode is Mode.STOPPED
    fixture.grant(2)
    with refuses("stopped"):
        fixture.offer(2)
    rest = fixture.elbow
    fixture.controller.reset_stop(epoch=3)
    fixture.run(0.5)
    assert fixture.elbow == pytest.approx(rest, abs=1e-9)
    with refuses("no_lease"):
        fixture.offer(2)
    fixture.grant(4)
    fixture.stream(4, 0.5)
    assert fixture.elbow != rest


def test_after_a_reset_earlier_epochs_are_rejected_and_do_not_release_a_later_stop() -> None:
    fixture = leased()
    fixture.stop()
    fixture.controller.reset_stop(epoch=3)
    for epoch, code in ((1, "stale_epoch"), (2, "stale_epoch"), (3, "lease_ended")):
        with refuses(code):
            fixture.reserve(epoch)
        with refuses(code):
            fixture.grant(epoch)
    fixture.stop()
    for epoch, code in ((3, "lease_ended"), (2, "stale_epoch"), (0, "stale_epoch")):
        with refuses(code):
            fixture.controller.reset_stop(epoch=epoch)
    assert fixture.controller.latch is not None
    fixture.controller.reset_stop(epoch=4)
    assert fixture.controller.latch is None


@pytest.mark.parametrize(
    ("position_rad", "code"),
    [
        ({"elbow": 3.1}, "out_of_range"),
        ({"knee": 0.0}, "unknown_joint"),
        *(({"elbow": value}, "not_finite") for value in (math.nan, math.inf, -math.inf)),
    ],
)
def test_an_invalid_goal_is_rejected_completely(position_rad: dict[str, float], code: str) -> None:
    fixture = ControllerFixture()
    with refuses(code):
        fixture.move(shoulder=1.0, **position_rad)
    fixture.run(0.5)
    assert not fixture.controller.moving


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.1, math.nan, math.inf])
def test_an_invalid_speed_is_rejected(speed: float) -> None:
    with refuses("bad_speed"):
        ControllerFixture().move(speed, elbow=1.0)


@pytest.mark.parametrize("cause", interruptions())
def test_a_revoked_action_cannot_move_the_device(cause: str) -> None:
    fixture = ControllerFixture()
    fixture.grant(1, lease_s=5.0)
    move = fixture.move(0.1, elbow=2.9)
    fixture.run(0.5)
    interruptions()[cause](fixture)
    fixture.run(0.3)
    assert move.result is GoalResult.INTERRUPTED
    assert len(fixture.revocations) == 1
    assert not fixture.controller.moving
    with pytest.raises(Refused):
        fixture.move(elbow=-1.0)


def test_setpoints_and_actions_are_rejected_while_an_action_runs() -> None:
    fixture = leased()
    reservation = fixture.reserve()
    with refuses("busy"):
        fixture.offer(1)
    with refuses("busy"):
        fixture.reserve()
    fixture.controller.end_reservation(reservation)
    fixture.offer(1)
    with refuses("not_finite"):
        fixture.offer(1, math.nan)


def test_repeated_faults_are_one_fault_and_recovery_needs_a_fault() -> None:
    fixture = ControllerFixture()
    fixture.controller.clear_fault([1.0, 1.0])
    fixture.run(PERIOD_S)
    assert fixture.elbow == 0.0, "without a fault it stays where it is"
    fixture.controller.set_fault("no answer")
    fixture.controller.set_fault("no answer")
    assert fixture.run(PERIOD_S) is Mode.FAULT
    fixture.controller.clear_fault([1.0, 1.0])
    assert fixture.run(PERIOD_S) is Mode.IDLE
    assert fixture.elbow == 1.0


# ---------------------------------------------------------------- interlocks


def test_the_strictest_restriction_applies_until_it_is_lifted() -> None:
    restrictions = Restrictions()
    assert (restrictions.speed, restrictions.strictest, restrictions.all) == (1.0, None, ())
    restrictions.set("door", 0.5, "the door is open")
    restrictions.set("zone", 0.2, "a person is near")
    assert restrictions.speed == 0.2
    assert restrictions.strictest == Restriction("zone", 0.2, "a person is near")
    restrictions.clear("zone")
    restrictions.clear("never set")
    assert restrictions.speed == 0.5
    for speed in (math.nan, math.inf, -0.1, 1.1):
        restrictions.set("zone", speed, "invalid")
        assert restrictions.speed == 0.0


def test_a_restriction_slows_a_stream_and_is_reported() -> None:
    fixture = leased()
    fixture.controller.restrict("zone", 0.25, PERSON)
    assert fixture.controller.restrictions == (Restriction("zone", 0.25, PERSON),)
    fixture.stream(1, 1.5)
    assert 0.2 < max(fixture.velocities) <= 0.25 * 0.35 * 3.0 + 1e-6
    assert fixture.limited == {f"interlock: {PERSON}"}
    fixture.controller.lift("zone")
    fixture.stream(1, 0.6)
    assert max(fixture.velocities) > 0.9


def test_a_restriction_slows_a_goal_until_it_is_lifted() -> None:
    fixture = ControllerFixture()
    move = fixture.move(elbow=2.5)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.1, PERSON)
    fixture.run(1.0)
    assert abs(fixture.velocities[-1]) <= 0.1 * 3.0 + 1e-6
    assert not move.finished.is_set()
    fixture.controller.lift("zone")
    fixture.run(2.0)
    assert move.result is GoalResult.REACHED
    assert move.limited == (f"interlock: {PERSON}",)
    assert fixture.elbow == pytest.approx(2.5, abs=1e-4)
    fixture.controller.end_reservation(fixture.reservation)
    assert fixture.run(0.1) is Mode.IDLE


def test_a_hold_stops_a_stream_and_lifting_it_resumes_nothing() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    fixture.controller.restrict("zone", 0.0, PERSON)
    assert fixture.at_rest_after(0.5) < 0.2
    assert fixture.controller.mode is Mode.HOLDING
    fixture.controller.lift("zone")
    rest = fixture.elbow
    with refuses("no_lease"):
        fixture.offer(1)
    fixture.run(1.0)
    assert fixture.elbow == pytest.approx(rest, abs=1e-9)
    fixture.grant(2)
    fixture.stream(2, 0.3)
    assert fixture.elbow > rest


def test_a_hold_ends_an_action_and_rejects_the_next() -> None:
    fixture = ControllerFixture()
    move = fixture.move(0.5, elbow=2.5)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.0, PERSON)
    fixture.run(0.3)
    assert (move.result, [why.code for why in fixture.revocations]) == (GoalResult.INTERRUPTED, ["interlock"])
    assert not fixture.controller.moving
    with pytest.raises(Refused, match=PERSON) as refused:
        fixture.reserve(2)
    assert refused.value.code == "interlock"


def test_a_hold_at_rest_keeps_the_lease_until_a_setpoint_arrives() -> None:
    fixture = leased()
    fixture.controller.restrict("zone", 0.0, PERSON)
    assert fixture.run(0.1) is Mode.HOLDING
    fixture.controller.lift("zone")
    assert fixture.run(0.1) is Mode.IDLE
    fixture.stream(1, 0.1)
    fixture.stream(1, 2.0, elbow=0.0)
    fixture.run(0.5)
    fixture.controller.restrict("zone", 0.0, PERSON)
    with refuses("interlock"):
        fixture.offer(1)
    fixture.controller.lift("zone")
    with refuses("no_lease"):
        fixture.offer(1)


def test_a_hold_discards_a_waiting_setpoint() -> None:
    fixture = leased()
    fixture.offer(1)
    fixture.controller.restrict("zone", 0.0, PERSON)
    fixture.controller.lift("zone")
    fixture.run(0.3)
    assert fixture.elbow == 0.0
