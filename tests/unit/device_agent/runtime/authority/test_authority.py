"""Authority: which leases, Stops and faults end the right to move, and what is recorded."""

from collections.abc import Callable

import pytest

from device_agent.protocol import StopLatch
from device_agent.protocol.events import EventKind
from device_agent.protocol.security.setpoints import SetpointKey
from device_agent.runtime.authority.authority import Authority
from device_agent.runtime.authority.event_recorder import EventRecord
from device_agent.runtime.authority.lease_gate import LeaseGate
from device_agent.runtime.errors import Refused
from tests.harness.agent.controller_fixture import refuses

LATCH = StopLatch(caller="bob", reason="smoke", at_ms=5)
KEYS = (SetpointKey(b"key", "topic"),)


class Fixture:
    """An authority, the reasons of its holds and revocations, and its events."""

    def __init__(self, *, latch: StopLatch | None = None, epoch: int = 0) -> None:
        self.holds: list[Refused] = []
        self.revocations: list[Refused] = []
        self.events: list[EventRecord] = []
        gate = LeaseGate(epoch=epoch, burned=epoch)
        self.authority = Authority(gate, latch, hold=self.holds.append, record=self.events.append)

    def grant(self, epoch: int, *, holder: str = "ann", now_s: float = 0.0, reason: str = "") -> bool:
        return self.authority.grant(epoch=epoch, holder=holder, lease_s=10.0, now_s=now_s, reason=reason, keys=KEYS)

    def event(self, kind: EventKind) -> EventRecord:
        """The only event of this kind."""
        (event,) = (event for event in self.events if event.kind is kind)
        return event

    def acting(self) -> None:
        """Grant lease 3, reserve the device for an action, and forget what was recorded."""
        self.grant(3)
        self.authority.reserve(3, self.revocations.append)
        self.authority.changed.clear()
        for records in (self.holds, self.events):
            records.clear()

    def expect_end(self, code: str) -> None:
        """The lease and the action have ended with this code, and the change is to be journalled."""
        authority = self.authority
        assert (authority.lease(1.0), authority.epochs, authority.ended) == (None, (3, 3), True)
        assert authority.changed.is_set()
        assert authority.reservation is None
        assert [why.code for why in self.holds] == [why.code for why in self.revocations] == [code]
        assert self.holds[0].message
        lost = self.event(EventKind.ACTION_LOST)
        assert (lost.severity, lost.data) == ("warning", {"code": code, "epoch": 3})
        assert self.event(EventKind.LEASE_ENDED).data == {"epoch": 3, "holder": "ann", "code": code}
        with refuses("lease_ended"):
            self.grant(3)


@pytest.mark.parametrize(
    ("end", "code"),
    [
        (lambda authority: authority.stop(LATCH), "stopped"),
        (lambda authority: authority.reset_stop(), "lease_lost"),
        (lambda authority: authority.release(3), "lease_lost"),
        (lambda authority: authority.expire(10.0), "lease_lost"),
        (lambda authority: authority.set_fault("no answer"), "fault"),
        (lambda authority: authority.end_input(Refused("too_old", "late")), "too_old"),
    ],
    ids=["stop", "reset", "release", "expiry", "fault", "watchdog"],
)
def test_lease_and_action_end(end: Callable[[Authority], None], code: str) -> None:
    fixture = Fixture()
    fixture.acting()
    end(fixture.authority)
    fixture.expect_end(code)


def test_a_stop_is_latched_and_recorded() -> None:
    fixture = Fixture()
    fixture.authority.check_free()
    fixture.authority.stop(LATCH)
    assert fixture.authority.latch == LATCH
    assert fixture.authority.changed.is_set()
    event = fixture.event(EventKind.STOP_LATCHED)
    assert (event.severity, event.data) == (
        "warning",
        {"stop": "", "caller": "bob", "reason": "smoke", "verified": False},
    )
    with pytest.raises(Refused, match="bob") as refused:
        fixture.authority.check_free()
    assert refused.value.code == "stopped"
    fixture.authority.reset_stop()
    fixture.authority.check_free()
    assert fixture.authority.latch is None


def test_stop_is_not_reset_while_the_device_has_stopped_itself() -> None:
    fixture = Fixture(latch=LATCH)
    fixture.grant(3)
    fixture.authority.follow_device_stop(LATCH)
    with refuses("device_stopped"):
        fixture.authority.reset_stop()
    assert fixture.authority.latch == LATCH
    fixture.authority.set_fault("no answer")  # the device is lost: whether it has stopped itself is unknown
    fixture.authority.reset_stop()
    fixture.authority.follow_device_stop(LATCH)
    assert fixture.authority.fault == LATCH.reason
    fixture.authority.clear_fault()
    fixture.authority.reset_stop()
    assert fixture.authority.latch is None


@pytest.mark.parametrize(
    ("first", "second", "shown"),
    [(False, False, "bob"), (False, True, "cat"), (True, False, "bob"), (True, True, "bob")],
)
def test_only_a_verified_stop_replaces_an_unverified_one(first: bool, second: bool, shown: str) -> None:
    fixture = Fixture()
    fixture.authority.stop(StopLatch(caller="bob", reason="smoke", at_ms=5, verified=first))
    fixture.authority.stop(StopLatch(caller="cat", reason="fire", at_ms=9, verified=second))
    latch = fixture.authority.latch
    assert latch is not None
    assert (latch.caller, latch.at_ms) == (shown, 5)
    verified = [event.data for event in fixture.events if event.kind is EventKind.STOP_VERIFIED]
    replaced = {"stop": "", "caller": "cat", "reason": "fire", "verified": True}
    assert verified == ([replaced] if shown == "cat" else [])


def test_a_restored_latch_prevents_motion() -> None:
    with refuses("stopped"):
        Fixture(latch=LATCH).authority.check_free()


@pytest.mark.parametrize("fence", [False, True])
def test_a_newer_epoch_ends_the_previous_lease(fence: bool) -> None:
    fixture = Fixture()
    fixture.acting()
    if fence:
        assert fixture.authority.fence(4)
    else:
        assert fixture.grant(4, holder="bob", now_s=1.0)
        granted = fixture.event(EventKind.LEASE_GRANTED)
        assert (granted.severity, granted.data) == ("info", {"epoch": 4, "holder": "bob"})
    assert fixture.authority.epochs == (4, 0)
    assert fixture.authority.changed.is_set()
    assert [why.code for why in fixture.holds] == [why.code for why in fixture.revocations] == ["lease_lost"]
    assert fixture.event(EventKind.LEASE_ENDED).data == {"epoch": 3, "holder": "ann", "code": "lease_lost"}
    lease = fixture.authority.lease(1.0)
    assert (lease and lease.holder) == (None if fence else "bob")


def test_a_renewal_and_a_command_of_the_same_epoch_end_nothing() -> None:
    fixture = Fixture()
    assert fixture.grant(3, reason="repair")
    assert not fixture.grant(3, now_s=5.0)
    assert not fixture.authority.fence(3)
    assert [event.kind for event in fixture.events] == [EventKind.LEASE_GRANTED]
    lease = fixture.authority.lease(14.9)
    assert lease is not None
    assert (lease.holder, lease.epoch, lease.expires_s, lease.reason, lease.keys) == ("ann", 3, 15.0, "repair", KEYS)
    fixture.authority.expire(14.9)
    assert not fixture.authority.ended
    fixture.authority.expire(15.0)
    assert fixture.authority.ended


def test_the_epoch_of_an_expired_lease_is_burned() -> None:
    gate = LeaseGate()
    assert (gate.epoch, gate.input, gate.ended_input) == (0, 0, 0)
    gate.grant(epoch=3, holder="ann", lease_s=5.0, now_s=10.0)
    assert [gate.current(now_s) is not None for now_s in (14.9, 15.0)] == [True, False]
    assert not gate.expire(14.9)
    assert gate.expire(15.0)
    assert (gate.burned, gate.granted) == (3, None)
    assert not gate.expire(16.0)
    with refuses("lease_ended"):
        gate.grant(epoch=3, holder="ann", lease_s=5.0, now_s=16.0)


def test_commands_of_ended_and_older_epochs_are_rejected() -> None:
    fixture = Fixture()
    fixture.acting()
    fixture.authority.release(3)
    with refuses("lease_ended"):
        fixture.authority.fence(3)
    for outdated in (fixture.grant, fixture.authority.fence, fixture.authority.release):
        with refuses("stale_epoch"):
            outdated(2)


def test_the_watchdog_ends_only_a_numbered_input() -> None:
    fixture = Fixture()
    fixture.acting()
    fixture.authority.check_input(4)
    assert not fixture.authority.ended
    fixture.authority.end_input(Refused("too_old", ""))
    assert [why.code for why in fixture.holds] == ["too_old"]
    assert (fixture.authority.ended, fixture.authority.ended_input) == (True, 4)
    assert fixture.authority.lease(1.0) is not None
    assert fixture.revocations == []
    with refuses("input_ended"):
        fixture.authority.check_input(4)
    fixture.authority.check_input(5)
    assert not fixture.authority.ended


def test_one_action_at_a_time_reserves_the_device() -> None:
    fixture = Fixture()
    fixture.acting()
    reservation = fixture.authority.reservation
    assert reservation is not None
    assert reservation.epoch == 3
    fixture.authority.check_reservation(reservation)
    with refuses("busy"):
        fixture.authority.reserve(3, fixture.revocations.append)
    fixture.authority.stop(LATCH)
    with refuses("stopped"):
        fixture.authority.check_reservation(reservation)
    reservation.why = None
    with refuses("ended"):
        fixture.authority.check_reservation(reservation)


def test_a_fault_prevents_motion_until_it_is_cleared() -> None:
    fixture = Fixture()
    assert not fixture.authority.clear_fault()
    fixture.authority.set_fault("no answer")
    with pytest.raises(Refused, match="no answer") as refused:
        fixture.authority.check_free()
    assert refused.value.code == "fault"
    assert fixture.authority.clear_fault()
    fixture.authority.check_free()
    assert not fixture.authority.clear_fault()


def test_only_a_restriction_to_zero_prevents_motion() -> None:
    fixture = Fixture()
    fixture.authority.restrictions.set("door", 0.1, "a door is open")
    fixture.authority.check_free()
    fixture.authority.restrictions.set("person", 0.0, "a person is there")
    with pytest.raises(Refused, match="a person is there") as refused:
        fixture.authority.check_free()
    assert refused.value.code == "interlock"


@pytest.mark.parametrize("room", [False, True])
def test_a_goal_of_the_running_action_needs_a_device_that_may_move(room: bool) -> None:
    fixture = Fixture()
    fixture.acting()
    reservation = fixture.authority.reservation
    assert reservation is not None
    fixture.authority.check_goal(reservation)
    if room:
        fixture.authority.restrictions.set("person", 0.0, "a person is there")
    else:
        fixture.authority.suspended = "The agent restarts."
    with refuses("interlock" if room else "restarting"):
        fixture.authority.check_goal(reservation)


def test_a_suspended_device_grants_no_lease() -> None:
    fixture = Fixture()
    fixture.authority.suspended = "The agent restarts."
    with refuses("restarting"):
        fixture.grant(3)
    fixture.authority.suspended = ""
    assert fixture.grant(3)


def test_a_device_that_stops_itself_ends_lease_and_action_as_a_fault() -> None:
    fixture = Fixture()
    fixture.acting()
    authority = fixture.authority
    authority.follow_device_stop(LATCH)
    assert [(why.code, why.message) for why in fixture.revocations] == [("fault", LATCH.reason)]
    assert fixture.event(EventKind.LEASE_ENDED).data == {"epoch": 3, "holder": "ann", "code": "fault"}
    assert (authority.latch, authority.fault, authority.device_stopped) == (LATCH, LATCH.reason, True)


def test_another_reason_of_the_same_stop_of_the_device_ends_nothing() -> None:
    fixture = Fixture(latch=LATCH)
    authority = fixture.authority
    authority.follow_device_stop(StopLatch(caller="the device", reason="hit", at_ms=6))
    fixture.holds.clear()
    authority.follow_device_stop(StopLatch(caller="the device", reason="clearing", at_ms=7))
    assert (fixture.holds, fixture.revocations) == ([], [])
    assert (authority.latch, authority.fault) == (LATCH, "clearing")
