"""Controller: a watchdog hold ends the operator's input and keeps the lease; only a new input resumes motion."""

import pytest

from device_agent.protocol import DriveTarget, Mode
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.errors import Refused
from tests.fakes.drivers import BASE, PERIOD_S
from tests.harness.agent.controller_fixture import ControllerFixture, interruptions, leased, refuses

FORWARD = DriveTarget(forward_m_s=0.3)


def held(*, lease_s: float = 30.0) -> ControllerFixture:
    """A controller that the watchdog holds in input 1 of lease 1, at rest."""
    fixture = ControllerFixture()
    fixture.grant(1, lease_s=lease_s)
    fixture.press()
    fixture.stream(1, 1.0)
    assert fixture.controller.moving
    assert fixture.at_rest_after(1.0) <= 0.3 + PERIOD_S
    return fixture


def test_a_gap_stops_the_motion_and_keeps_the_lease() -> None:
    fixture = held()
    assert fixture.controller.mode is Mode.HOLDING
    assert fixture.lease_epoch == 1
    assert fixture.controller.epochs == (1, 0)
    assert fixture.run(5.0) is Mode.HOLDING, "until the operator starts a new input"
    assert (fixture.outputs[-1].epoch, fixture.outputs[-1].ended_input) == (1, 1)


def test_delayed_and_continued_setpoints_of_the_held_input_move_nothing() -> None:
    fixture = held()
    rest = fixture.elbow
    for gap_s in (0.0, 0.2, 1.0, 5.0):
        fixture.run(gap_s)
        for _ in range(20):
            with refuses("input_ended"):
                fixture.offer(1)
            fixture.run(0.024)
    assert fixture.elbow == rest


def test_a_new_input_resumes_under_the_same_epoch_and_keeps_out_the_old_input() -> None:
    fixture = held()
    rest = fixture.elbow
    fixture.press()
    assert fixture.stream(1, 0.5) is Mode.STREAMING
    assert fixture.elbow > rest + 0.05
    assert (fixture.outputs[-1].epoch, fixture.outputs[-1].ended_input) == (1, 1)
    late = fixture.sequence + 1
    fixture.input = 1
    with refuses("input_ended"):
        fixture.offer(1, -2.0, sequence=late)
    fixture.input = 2
    with refuses("out_of_order"):
        fixture.offer(1, -2.0, sequence=late)
    assert fixture.at_rest_after(1.0) <= 0.3 + PERIOD_S
    with refuses("input_ended"):
        fixture.offer(1)


def test_a_new_input_while_the_device_still_brakes_resumes() -> None:
    fixture = leased()
    fixture.press()
    fixture.stream(1, 1.0)
    while fixture.controller.mode is Mode.STREAMING:
        fixture.run(PERIOD_S)
    assert fixture.controller.moving
    with refuses("input_ended"):
        fixture.offer(1)
    fixture.press()
    assert fixture.stream(1, 0.1) is Mode.STREAMING


def test_reordered_setpoints_of_two_inputs_keep_the_newer_input() -> None:
    fixture = leased()
    fixture.input = 2
    fixture.offer(1, 1.0, sequence=5)
    fixture.input = 1
    with refuses("out_of_order"):
        fixture.offer(1, -1.0, sequence=4)
    with refuses("input_ended"):
        fixture.offer(1, -1.0, sequence=6)
    fixture.run(0.1)
    assert fixture.elbow > 0


def test_setpoints_that_stop_at_rest_keep_their_input() -> None:
    fixture = leased()
    fixture.press()
    fixture.stream(1, 3.5)
    assert fixture.run(2.0) is Mode.IDLE
    assert fixture.outputs[-1].ended_input == 0
    assert fixture.stream(1, 0.5, elbow=1.0) is Mode.STREAMING


def test_a_base_that_a_gap_stops_needs_a_new_input() -> None:
    fixture = ControllerFixture(base=BASE)
    fixture.grant(1)
    fixture.press()
    fixture.stream(1, 1.0, FORWARD)
    assert fixture.at_rest_after(1.0) <= 0.3 + PERIOD_S
    with refuses("input_ended"):
        fixture.offer(1, FORWARD)
    fixture.press()
    assert fixture.stream(1, 0.2, FORWARD) is Mode.STREAMING
    assert fixture.controller.moving


def test_a_hold_of_setpoints_without_a_number_ends_the_lease() -> None:
    fixture = leased()
    fixture.stream(1, 1.0)
    assert fixture.at_rest_after(1.0) <= 0.3 + PERIOD_S
    assert fixture.lease_epoch is None
    assert fixture.controller.epochs == (1, 1)


def test_a_lease_with_numbered_inputs_accepts_none_without_a_number() -> None:
    fixture = held()
    fixture.input = 0
    with refuses("input_ended"):
        fixture.offer(1)
    fixture.input = 2
    fixture.offer(1)
    fixture.input = 0
    with refuses("input_ended"):
        fixture.offer(1)


@pytest.mark.parametrize("cause", sorted(set(interruptions()) - {"link"}))
def test_the_end_of_the_lease_during_a_gap_also_refuses_new_inputs(cause: str) -> None:
    fixture = held(lease_s=5.0)
    rest = fixture.elbow
    interruptions()[cause](fixture)
    for _ in range(3):
        fixture.press()
        with refuses("no_lease"):
            fixture.offer(1)
        fixture.run(0.1)
    assert fixture.elbow == pytest.approx(rest, abs=1e-9)


def test_a_renewal_during_a_gap_neither_resumes_the_held_input_nor_moves_the_device() -> None:
    fixture = held(lease_s=5.0)
    sequence, rest = fixture.sequence, fixture.elbow
    fixture.grant(1)
    fixture.sequence = sequence
    with refuses("input_ended"):
        fixture.offer(1)
    fixture.run(6.0)
    assert fixture.elbow == rest
    fixture.press()
    assert fixture.stream(1, 0.2) is Mode.STREAMING


def test_the_next_epoch_counts_inputs_from_the_start() -> None:
    fixture = held()
    fixture.grant(2)
    fixture.run(PERIOD_S)
    assert (fixture.outputs[-1].epoch, fixture.outputs[-1].ended_input) == (2, 0)
    fixture.input = 1
    assert fixture.stream(2, 0.2) is Mode.STREAMING


def test_a_room_that_holds_refuses_a_new_input_and_ends_the_lease() -> None:
    fixture = held()
    fixture.controller.restrict("zone", 0.0, "a person is there")
    assert fixture.lease_epoch == 1, "at rest"
    with refuses("input_ended"):
        fixture.offer(1)
    assert fixture.lease_epoch == 1
    fixture.press()
    with refuses("interlock"):
        fixture.offer(1)
    assert fixture.lease_epoch is None


def test_a_lost_link_after_a_gap_keeps_the_lease_of_the_resting_device() -> None:
    fixture = held()
    fixture.controller.interrupt(Refused("link_lost", "the link is lost"))
    assert fixture.lease_epoch == 1
    with refuses("input_ended"):
        fixture.offer(1)


def test_a_restarted_agent_accepts_no_input_of_an_earlier_lease() -> None:
    epoch, _ = held().controller.epochs
    restarted = ControllerFixture(epoch=epoch, burned=epoch)
    for number in (1, 2, 99):
        restarted.input = number
        with refuses("no_lease"):
            restarted.offer(1)
    with refuses("lease_ended"):
        restarted.grant(1)


def test_a_hold_is_recorded_once_with_the_measured_time() -> None:
    events = list[EventRecord]()
    fixture = ControllerFixture(record=events.append)
    fixture.grant(1)
    fixture.press()
    fixture.stream(1, 1.0)
    fixture.run(2.0)
    (event,) = [each for each in events if each.kind == "motion-held"]
    assert event.data == {"code": "watchdog", "epoch": 1}
    silent_ms = int(event.message.removeprefix("no setpoint for ").split()[0])
    assert 150 <= silent_ms <= 300
    assert not [each for each in events if each.kind == "lease-ended"]
