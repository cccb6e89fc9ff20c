"""Events of a device: changes of authority and rejections."""

import sqlite3
import time
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol import (
    AckStatus,
    Description,
    Event,
    GrantLease,
    Mode,
    MoveJoints,
    ReleaseLease,
    ResetStop,
    State,
    Stop,
    StopDevice,
    Twin,
    codec,
    topics,
)
from device_agent.protocol.events import EventKind
from device_agent.protocol.security import signing
from tests.harness.agent.device_harness import DeviceHarness, eventually


def events(harness: DeviceHarness, kind: EventKind) -> list[Event]:
    return [event for event in harness.heard(topics.EVENT, Event) if event.kind == kind]


def event(harness: DeviceHarness, kind: EventKind) -> Event:
    found: Event = eventually(lambda: events(harness, kind)[-1:])[0]
    assert found.device == "arm"
    assert found.at_ms > 0
    return found


def take_control(harness: DeviceHarness, epoch: int = 1, holder: str = "ann") -> None:
    assert (
        harness.end(harness.command(GrantLease(holder=holder, lease_ms=10_000), epoch=epoch)).status is AckStatus.DONE
    )


def test_start_and_shutdown_are_events(harness: DeviceHarness) -> None:
    assert event(harness, EventKind.AGENT_STARTED).data == {"epoch": 0, "stopped": False}
    harness.device.stop()
    assert event(harness, EventKind.AGENT_STOPPED)


def test_grant_and_end_of_a_lease_are_events_but_renewal_is_not(harness: DeviceHarness) -> None:
    take_control(harness)
    take_control(harness)
    assert harness.end(harness.command(ReleaseLease(), epoch=1)).status is AckStatus.DONE
    ended = event(harness, EventKind.LEASE_ENDED)
    assert ended.data == {"epoch": 1, "holder": "ann", "code": "lease_lost"}
    assert [granted.data for granted in events(harness, EventKind.LEASE_GRANTED)] == [{"epoch": 1, "holder": "ann"}]


def test_an_expired_lease_is_an_event_with_its_holder(harness: DeviceHarness) -> None:
    harness.end(harness.command(GrantLease(holder="ann", lease_ms=50), epoch=1))
    ended = event(harness, EventKind.LEASE_ENDED)
    assert ended.data["holder"] == "ann"
    assert "expired" in ended.message


def test_a_takeover_ends_the_previous_lease(harness: DeviceHarness) -> None:
    take_control(harness)
    take_control(harness, epoch=2, holder="bert")
    assert event(harness, EventKind.LEASE_ENDED).data == {"epoch": 1, "holder": "ann", "code": "lease_lost"}
    assert [granted.data["holder"] for granted in events(harness, EventKind.LEASE_GRANTED)] == ["ann", "bert"]


def test_a_stop_in_motion_records_its_effects_once(harness: DeviceHarness) -> None:
    take_control(harness)
    command = harness.command(MoveJoints(position_rad={"elbow": 2.0}), epoch=1)
    eventually(lambda: harness.telemetry().velocity_rad_s and harness.device._controller.moving)
    for _ in range(50):
        harness.receive(topics.STOP, codec.encode(Stop(id="s1", caller="cat", reason="smoke")))
    assert harness.end(command).status is AckStatus.FAILED
    assert event(harness, EventKind.STOP_LATCHED).data == {"caller": "cat", "reason": "smoke"}
    assert event(harness, EventKind.MOTION_HELD).data == {"code": "stopped", "epoch": 1}
    assert event(harness, EventKind.ACTION_LOST).data == {"code": "stopped", "epoch": 1}
    assert event(harness, EventKind.LEASE_ENDED).data["code"] == "stopped"
    harness.end(harness.command(ResetStop(), epoch=2))
    assert event(harness, EventKind.STOP_RESET).data == {"caller": "ann"}
    told = harness.heard(topics.EVENT, Event)
    assert len(told) == len({each.id for each in told}) <= 8, "fifty Stops are one fact"


def test_a_reset_of_nothing_is_no_event(harness: DeviceHarness) -> None:
    harness.end(harness.command(ResetStop(), epoch=3))
    harness.end(harness.command(StopDevice(reason="")))
    assert event(harness, EventKind.STOP_LATCHED)
    assert events(harness, EventKind.STOP_RESET) == []


def test_a_flood_of_setpoints_without_a_lease_is_one_event(harness: DeviceHarness) -> None:
    for number in range(200):
        harness.setpoint(epoch=7, sequence=number + 1)
    refused = event(harness, EventKind.SETPOINTS_REJECTED)
    assert refused.data == {"code": "no_lease"}
    assert refused.severity == "warning"
    harness.device.stop()
    eventually(lambda: len(events(harness, EventKind.SETPOINTS_REJECTED)) == 2)
    first, rest = events(harness, EventKind.SETPOINTS_REJECTED)
    assert (first.id, rest.data) == (refused.id, {"code": "no_lease", "count": 199})


def test_rejected_commands_are_events_with_the_readable_fields(harness: DeviceHarness) -> None:
    harness.receive(topics.CMD, signing.sign(b"{}", signing.generate()))
    assert event(harness, EventKind.COMMAND_REJECTED).data == {"code": "bad_signature"}
    harness.command(StopDevice(reason=""), device="other")
    eventually(lambda: events(harness, EventKind.COMMAND_REJECTED)[-1].data["code"] == "wrong_address")
    command = harness.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=3, issued_at_ms=1)
    harness.end(command)
    expected = {"code": "expired", "command": command, "request": "move_joints", "caller": "ann", "epoch": 3}
    eventually(lambda: events(harness, EventKind.COMMAND_REJECTED)[-1].data == expected)
    signed = signing.sign(b"{}", harness.key)
    harness.receive(topics.CMD, signed)
    eventually(lambda: events(harness, EventKind.COMMAND_REJECTED)[-1].data == {"code": "malformed"})


def test_a_malformed_stop_is_an_event(harness: DeviceHarness) -> None:
    harness.receive(topics.STOP, b"stop!")
    assert event(harness, EventKind.STOP_REJECTED).data == {"code": "malformed"}


def test_driver_failure_and_recovery_are_events(harness: DeviceHarness) -> None:
    take_control(harness)
    harness.driver.broken = True
    assert "switched on" in event(harness, EventKind.DRIVER_FAILED).message
    assert event(harness, EventKind.LEASE_ENDED).data["code"] == "fault"
    harness.driver.broken = False
    assert event(harness, EventKind.DRIVER_RECOVERED)


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
        harness.receive(topics.STOP, codec.encode(Stop(id="s1", caller="cat")))
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
    def mistake(_: object) -> None:
        raise RuntimeError("a mistake")

    with monkeypatch.context() as patch:
        patch.setattr(harness.device.publisher, "publish_state", mistake)
        eventually(lambda: "a mistake" in caplog.text)
    take_control(harness)


def test_foreign_classes_are_ignored_and_the_twin_is_published(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.driver.twin = lambda: Twin(device="arm", bodies=())  # type: ignore[method-assign]
    harness.start()
    harness.receive(topics.TELE, b"{}", "joints")
    assert eventually(lambda: harness.heard(topics.DESC, Twin, topics.TWIN)) == [Twin(device="arm", bodies=())]
    assert harness.device.quiet
    assert harness.device.publisher.rejections == {}
    harness.stop()


def test_an_interlock_without_reading_holds_and_is_published(tmp_path: Path) -> None:
    rule = InterlockRule(device="sensors-pir", stream="presence", field="present", equals=True)
    harness = DeviceHarness(tmp_path, interlocks=(rule,))
    harness.start()
    (acted,) = eventually(lambda: events(harness, EventKind.INTERLOCK_ENGAGED))
    assert acted.data["interlock"] == rule.name
    (shown,) = eventually(lambda: [state.restrictions for state in harness.heard(topics.STATE, State)][-1:])
    assert [(each.source, each.speed) for each in shown] == [(rule.name, 0.0)]
    assert harness.heard(topics.DESC, Description)[0].interlocks == (rule.description,)
    take_control(harness)
    refused = harness.end(harness.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=1))
    assert refused.status is AckStatus.FAILED
    assert not harness.device._controller.moving
    harness.stop()


def test_an_unsent_state_is_published_again(harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> None:
    eventually(lambda: harness.heard(topics.STATE, State))
    with monkeypatch.context() as patch:
        patch.setattr(harness.device.publisher, "_publish", lambda *_, **__: False)
        harness.device.link_changed(True)
        time.sleep(0.3)
    before = len(harness.heard(topics.STATE, State))
    eventually(lambda: len(harness.heard(topics.STATE, State)) > before)


def test_an_unconfirmed_ack_is_sent_again_on_reconnection(harness: DeviceHarness) -> None:
    with mock.patch.object(harness.device.publisher, "_delivered"):
        command = harness.command(StopDevice())
        harness.end(command)
    before = len(harness.acks(command))
    harness.device.link_changed(True)
    eventually(lambda: len(harness.acks(command)) > before)


def test_acks_are_sent_again_after_the_settle_time(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.outbox.settle_s = 1000.0
    harness.start()
    command = harness.command(StopDevice())
    answer = harness.end(command)
    time.sleep(0.3)
    assert harness.journal.undelivered("arm") == (answer,)
    harness.device.publisher._acks_valid_from_s = 0.0
    eventually(lambda: harness.acks(command)[-2:] == [answer, answer])
    eventually(lambda: harness.journal.undelivered("arm") == ())
    later = harness.command(StopDevice())
    harness.end(later)
    eventually(lambda: harness.journal.undelivered("arm") == ())
    assert [ack.status for ack in harness.acks(later)] == [AckStatus.DONE]
    harness.stop()
