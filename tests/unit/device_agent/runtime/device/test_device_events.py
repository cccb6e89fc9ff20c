"""Events of a device: changes of authority and rejections."""

import sqlite3
import time
from typing import Any
from unittest import mock

import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol import (
    Description,
    Event,
    GrantLease,
    Mode,
    MoveJoints,
    ReleaseLease,
    ResetStop,
    State,
    StopDevice,
    Twin,
    topics,
)
from device_agent.protocol.events import EventKind
from device_agent.protocol.security import signing
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.device_harness import DeviceHarness, eventually, wait_for_state
from tests.unit.device_agent.runtime.conftest import MakeDevice


def event(harness: DeviceHarness, kind: EventKind) -> Event:
    """The newest event of a kind."""
    newest: Event = eventually(lambda: harness.events(kind)[-1:])[0]
    assert newest.device == "arm"
    assert newest.at_ms > 0
    return newest


def grant(harness: DeviceHarness, epoch: int = 1, holder: str = "ann") -> None:
    harness.done(GrantLease(holder=holder, lease_ms=10_000), epoch=epoch)


def test_start_and_shutdown_are_events(harness: DeviceHarness) -> None:
    assert event(harness, EventKind.AGENT_STARTED).data == {"epoch": 0, "stopped": False}
    harness.device.stop()
    assert event(harness, EventKind.AGENT_STOPPED)


def test_grant_and_end_of_a_lease_are_events_but_renewal_is_not(harness: DeviceHarness) -> None:
    grant(harness)
    grant(harness)
    grant(harness, 2, "bert")
    lost = {"epoch": 1, "holder": "ann", "code": "lease_lost"}
    assert event(harness, EventKind.LEASE_ENDED).data == lost
    harness.done(ReleaseLease(), epoch=2)
    eventually(lambda: harness.events(EventKind.LEASE_ENDED)[-1].data == lost | {"epoch": 2, "holder": "bert"})
    granted = [each.data for each in harness.events(EventKind.LEASE_GRANTED)]
    assert granted == [{"epoch": 1, "holder": "ann"}, {"epoch": 2, "holder": "bert"}]
    harness.done(GrantLease(holder="cat", lease_ms=50), epoch=3)
    ended = eventually(lambda: harness.events(EventKind.LEASE_ENDED)[2:])[0]
    assert ended.data["holder"] == "cat"
    assert "expired" in ended.message


def test_the_moving_time_of_operator_and_machine_is_an_event_of_the_lease(harness: DeviceHarness) -> None:
    harness.done(MoveJoints(position_rad={"elbow": 0.5}), epoch=1)
    machine = event(harness, EventKind.ACTIVITY).data
    assert (machine["epoch"], machine["operator_s"], machine["first_input_s"]) == (1, 0.0, None)
    assert machine["machine_s"] > 0.1
    grant(harness, 2)
    for sequence in range(1, 10):
        harness.setpoint(2, sequence)
        time.sleep(0.02)
    harness.done(ReleaseLease(), epoch=2)
    operator = eventually(lambda: [each for each in harness.events(EventKind.ACTIVITY) if each.data["epoch"] == 2])
    assert operator[-1].data["operator_s"] > 0.05
    assert operator[-1].data["first_input_s"] >= 0


def test_a_stop_in_motion_records_its_effects_once(harness: DeviceHarness) -> None:
    grant(harness)
    harness.done(ResetStop(), epoch=2)
    command = harness.command(MoveJoints(position_rad={"elbow": 2.0}), epoch=3)
    eventually(lambda: harness.device._controller.moving)
    for _ in range(50):
        harness.receive_stop()
    assert harness.end_code(command) == "stopped"
    assert event(harness, EventKind.STOP_LATCHED).data == {
        "stop": "s1",
        "caller": "bob (unverified)",
        "reason": "smoke",
        "verified": False,
    }
    assert event(harness, EventKind.MOTION_HELD).data == {"code": "stopped", "epoch": 3}
    assert event(harness, EventKind.ACTION_LOST).data == {"code": "stopped", "epoch": 3}
    assert harness.events(EventKind.STOP_RESET) == [], "there was no Stop to reset"
    harness.done(ResetStop(), epoch=4)
    assert event(harness, EventKind.STOP_RESET).data == {"caller": "ann"}
    events = harness.published(topics.EVENT, Event)
    assert len(events) == len({each.id for each in events}) <= 8, "fifty Stops are one event"


def test_a_flood_of_setpoints_without_a_lease_is_one_event(harness: DeviceHarness) -> None:
    for number in range(200):
        harness.setpoint(epoch=7, sequence=number + 1)
    rejected = event(harness, EventKind.SETPOINTS_REJECTED)
    assert (rejected.data, rejected.severity) == ({"code": "no_lease"}, "warning")
    harness.device.stop()
    eventually(lambda: len(harness.events(EventKind.SETPOINTS_REJECTED)) == 2)
    first, rest = harness.events(EventKind.SETPOINTS_REJECTED)
    assert (first.id, rest.data) == (rejected.id, {"code": "no_lease", "count": 199})


def test_rejected_messages_are_events_with_the_readable_fields(harness: DeviceHarness) -> None:
    def await_rejection(**data: Any) -> None:
        eventually(lambda: [each for each in harness.events(EventKind.COMMAND_REJECTED)[-1:] if each.data == data])

    harness.receive(topics.CMD, signing.sign(b"{}", signing.generate()))
    await_rejection(code="bad_signature")
    harness.command(StopDevice(reason=""), device="other")
    eventually(lambda: harness.events(EventKind.COMMAND_REJECTED)[-1].data["code"] == "wrong_address")
    command = harness.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=3, issued_at_ms=1)
    await_rejection(code="expired", command=command, request="move_joints", caller="ann", epoch=3)
    harness.receive(topics.CMD, signing.sign(b"{}", harness.key))
    await_rejection(code="malformed")
    harness.receive(topics.STOP, b"stop!")
    assert event(harness, EventKind.STOP_REJECTED).data == {"code": "malformed"}


def test_driver_failure_and_recovery_are_events_and_faults(harness: DeviceHarness) -> None:
    grant(harness)
    harness.driver.broken = True
    assert "switched on" in event(harness, EventKind.DRIVER_FAILED).message
    assert event(harness, EventKind.LEASE_ENDED).data["code"] == "fault"
    assert "switched on" in wait_for_state(harness, lambda state: state.faults).faults[0].message
    assert harness.failed(MoveJoints(position_rad={"elbow": 0.2}), epoch=2).code == "fault"
    harness.driver.broken = False
    assert event(harness, EventKind.DRIVER_RECOVERED)
    wait_for_state(harness, lambda state: not state.faults)
    harness.done(MoveJoints(position_rad={"elbow": 0.1}), epoch=3)


def test_a_journal_error_is_an_event_and_the_command_is_not_applied(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FullDisk:
        def execute(self, *_: Any) -> Any:
            raise sqlite3.OperationalError("database or disk is full")

        def close(self) -> None:
            pass

    with monkeypatch.context() as patch:
        patch.setattr(harness.journal, "_database", FullDisk())
        harness.command(GrantLease(holder="ann", lease_ms=10_000), epoch=1)
        failed = event(harness, EventKind.JOURNAL_FAILED)
        assert failed.severity == "error"
        assert "disk full" in failed.message
        assert harness.device._controller.lease(0.0) is None
        harness.receive_stop()
        eventually(lambda: harness.device._controller.mode is Mode.STOPPED)
        time.sleep(0.3)
    eventually(lambda: harness.journal.device("arm").latch is not None)


def test_a_journal_error_at_shutdown_is_an_event(harness: DeviceHarness) -> None:
    harness.journal.close()
    harness.device._controller.changed.set()
    harness.device.stop()
    assert event(harness, EventKind.JOURNAL_FAILED)
    assert event(harness, EventKind.AGENT_STOPPED)


def test_an_unexpected_error_does_not_end_the_command_processor(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def mistake(*_: object, **__: object) -> None:
        raise RuntimeError("a mistake")

    with monkeypatch.context() as patch:
        patch.setattr(harness.device.publisher, "publish_state", mistake)
        eventually(lambda: "a mistake" in caplog.text)
    grant(harness)


def test_foreign_classes_are_ignored_and_the_twin_is_published(make_device: MakeDevice) -> None:
    driver, twin = FakeDriver(), Twin(device="arm", bodies=())
    driver.twin = lambda: twin  # type: ignore[method-assign]
    harness = make_device(driver=driver)
    harness.receive(topics.TELE, b"{}", "joints")
    assert eventually(lambda: harness.published(topics.DESC, Twin, topics.TWIN)) == [twin]
    assert harness.device.quiet
    assert harness.device.publisher.rejections == {}


def test_an_interlock_without_reading_holds_and_is_published(make_device: MakeDevice) -> None:
    rule = InterlockRule(device="sensors-pir", stream="presence", field="present", equals=True)
    harness = make_device(interlocks=(rule,))
    assert event(harness, EventKind.INTERLOCK_ENGAGED).data["interlock"] == rule.name
    state = wait_for_state(harness, lambda state: state.restrictions)
    assert [(each.source, each.speed) for each in state.restrictions] == [(rule.name, 0.0)]
    assert harness.published(topics.DESC, Description)[0].interlocks == (rule.description,)
    grant(harness)
    assert harness.failed(MoveJoints(position_rad={"elbow": 1.0}), epoch=1).code == "interlock"
    assert not harness.device._controller.moving


def test_an_unsent_state_is_published_again(harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> None:
    eventually(lambda: harness.published(topics.STATE, State))
    with monkeypatch.context() as patch:
        patch.setattr(harness.device.publisher, "_publish", lambda *_, **__: False)
        harness.device.link_changed(True)
        time.sleep(0.3)
    before = len(harness.published(topics.STATE, State))
    eventually(lambda: len(harness.published(topics.STATE, State)) > before)


def test_an_unconfirmed_ack_is_sent_again_on_reconnection(harness: DeviceHarness) -> None:
    with mock.patch.object(harness.device.publisher, "_delivered"):
        command = harness.done(StopDevice()).id
    before = len(harness.acks(command))
    harness.device.link_changed(True)
    eventually(lambda: len(harness.acks(command)) > before)


def test_an_ack_is_repeated_until_it_is_delivered(harness: DeviceHarness) -> None:
    publisher = harness.device.publisher
    with mock.patch.object(publisher, "_delivered"):
        ack = harness.done(StopDevice())
        eventually(lambda: len(harness.acks(ack.id)) > 1)
        assert all(each == ack for each in harness.acks(ack.id))
    eventually(lambda: not harness.journal.undelivered("arm"))
