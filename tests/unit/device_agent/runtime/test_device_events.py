"""Every change of authority at a device and every refusal leaves an event."""

import queue
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
from tests.harness.agent.device_harness import Bench, eventually


@pytest.fixture
def bench(tmp_path: Path):
    bench = Bench(tmp_path)
    bench.device.start()
    bench.device.link_changed(True)
    yield bench
    bench.device.stop()
    bench.outbox.stop()
    bench.journal.close()


def events(bench: Bench, kind: EventKind) -> list[Event]:
    return [event for event in bench.heard(topics.EVENT, Event) if event.kind == kind]


def event(bench: Bench, kind: EventKind) -> Event:
    found: Event = eventually(lambda: events(bench, kind)[-1:])[0]
    assert found.device == "arm"
    assert found.at_ms > 0
    return found


def take_control(bench: Bench, epoch: int = 1, holder: str = "ann") -> None:
    assert bench.end(bench.command(GrantLease(holder=holder, lease_ms=10_000), epoch=epoch)).status is AckStatus.DONE


def test_a_start_and_an_orderly_end_are_told(bench: Bench) -> None:
    assert event(bench, EventKind.AGENT_STARTED).data == {"epoch": 0, "stopped": False}
    bench.device.stop()
    assert event(bench, EventKind.AGENT_STOPPED)


def test_a_lease_is_told_when_granted_and_ended_but_not_when_renewed(bench: Bench) -> None:
    take_control(bench)
    take_control(bench)
    assert bench.end(bench.command(ReleaseLease(), epoch=1)).status is AckStatus.DONE
    ended = event(bench, EventKind.LEASE_ENDED)
    assert ended.data == {"epoch": 1, "holder": "ann", "code": "lease_lost"}
    assert [granted.data for granted in events(bench, EventKind.LEASE_GRANTED)] == [{"epoch": 1, "holder": "ann"}]


def test_a_lease_that_ran_out_is_told_with_its_holder(bench: Bench) -> None:
    bench.end(bench.command(GrantLease(holder="ann", lease_ms=50), epoch=1))
    ended = event(bench, EventKind.LEASE_ENDED)
    assert ended.data["holder"] == "ann"
    assert "expired" in ended.message


def test_a_take_over_ends_the_lease_before(bench: Bench) -> None:
    take_control(bench)
    take_control(bench, epoch=2, holder="bert")
    assert event(bench, EventKind.LEASE_ENDED).data == {"epoch": 1, "holder": "ann", "code": "lease_lost"}
    assert [granted.data["holder"] for granted in events(bench, EventKind.LEASE_GRANTED)] == ["ann", "bert"]


def test_a_stop_in_motion_is_told_as_what_it_did(bench: Bench) -> None:
    take_control(bench)
    command = bench.command(MoveJoints(position_rad={"elbow": 2.0}), epoch=1)
    eventually(lambda: bench.telemetry().velocity_rad_s and bench.device._controller.moving)
    for _ in range(50):
        bench.receive(topics.STOP, codec.encode(Stop(id="s1", caller="cat", reason="smoke")))
    assert bench.end(command).status is AckStatus.FAILED
    assert event(bench, EventKind.STOP_LATCHED).data == {"caller": "cat", "reason": "smoke"}
    assert event(bench, EventKind.MOTION_HELD).data == {"code": "stopped", "epoch": 1}
    assert event(bench, EventKind.ACTION_LOST).data == {"code": "stopped", "epoch": 1}
    assert event(bench, EventKind.LEASE_ENDED).data["code"] == "stopped"
    bench.end(bench.command(ResetStop(), epoch=2))
    assert event(bench, EventKind.STOP_RESET).data == {"caller": "ann"}
    told = bench.heard(topics.EVENT, Event)
    assert len(told) == len({each.id for each in told}) <= 8, "fifty Stops are one fact"


def test_a_reset_of_nothing_is_no_event(bench: Bench) -> None:
    bench.end(bench.command(ResetStop(), epoch=3))
    bench.end(bench.command(StopDevice(reason="")))
    assert event(bench, EventKind.STOP_LATCHED)
    assert events(bench, EventKind.STOP_RESET) == []


def test_a_flood_of_setpoints_without_a_lease_is_one_event(bench: Bench) -> None:
    for number in range(200):
        bench.setpoint(epoch=7, sequence=number + 1)
    refused = event(bench, EventKind.SETPOINTS_REJECTED)
    assert refused.data == {"code": "no_lease"}
    assert refused.severity == "warning"
    bench.device.stop()
    eventually(lambda: len(events(bench, EventKind.SETPOINTS_REJECTED)) == 2)
    first, rest = events(bench, EventKind.SETPOINTS_REJECTED)
    assert (first.id, rest.data) == (refused.id, {"code": "no_lease", "count": 199})


def test_refused_commands_are_told_with_what_could_be_read(bench: Bench) -> None:
    bench.receive(topics.CMD, signing.sign(b"{}", signing.generate()))
    assert event(bench, EventKind.COMMAND_REJECTED).data == {"code": "bad_signature"}
    bench.command(StopDevice(reason=""), device="other")
    eventually(lambda: events(bench, EventKind.COMMAND_REJECTED)[-1].data["code"] == "wrong_address")
    command = bench.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=3, issued_at_ms=1)
    bench.end(command)
    expected = {"code": "expired", "command": command, "request": "move_joints", "caller": "ann", "epoch": 3}
    eventually(lambda: events(bench, EventKind.COMMAND_REJECTED)[-1].data == expected)
    signed = signing.sign(b"{}", bench.key)
    bench.receive(topics.CMD, signed)
    eventually(lambda: events(bench, EventKind.COMMAND_REJECTED)[-1].data == {"code": "malformed"})


def test_a_stop_that_cannot_be_read_is_told(bench: Bench) -> None:
    bench.receive(topics.STOP, b"stop!")
    assert event(bench, EventKind.STOP_REJECTED).data == {"code": "malformed"}


def test_a_driver_that_fails_and_comes_back_is_told(bench: Bench) -> None:
    take_control(bench)
    bench.driver.broken = True
    assert "switched on" in event(bench, EventKind.DRIVER_FAILED).message
    assert event(bench, EventKind.LEASE_ENDED).data["code"] == "fault"
    bench.driver.broken = False
    assert event(bench, EventKind.DRIVER_RECOVERED)


def test_a_journal_that_cannot_be_written_is_told_and_the_command_not_obeyed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FullDisk:
        def execute(self, *_: Any) -> Any:
            raise sqlite3.OperationalError("database or disk is full")

        def close(self) -> None:
            pass

    with monkeypatch.context() as patch:
        patch.setattr(bench.journal, "_database", FullDisk())
        bench.command(GrantLease(holder="ann", lease_ms=10_000), epoch=1)
        failed = event(bench, EventKind.JOURNAL_FAILED)
        assert failed.severity == "error"
        assert "disk full" in failed.message
        assert bench.device._controller.lease(0.0) is None
        bench.receive(topics.STOP, codec.encode(Stop(id="s1", caller="cat")))
        eventually(lambda: bench.device._controller.mode is Mode.STOPPED)
        time.sleep(0.3)
    eventually(lambda: bench.journal.device("arm").latch is not None)


def test_a_journal_that_fails_at_the_end_is_told_too(bench: Bench) -> None:
    bench.journal.close()
    bench.device._controller.changed.set()
    bench.device.stop()
    assert event(bench, EventKind.JOURNAL_FAILED)
    assert event(bench, EventKind.AGENT_STOPPED)


def test_commands_beyond_what_can_wait_are_refused_and_told(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: bytes) -> None:
        raise queue.Full

    monkeypatch.setattr(bench.device._commands._commands, "put_nowait", full)
    bench.command(ResetStop())
    assert event(bench, EventKind.COMMAND_REJECTED).data == {"code": "overrun"}


def test_a_mistake_in_the_office_ends_neither_the_office_nor_the_device(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def mistake(_: object) -> None:
        raise RuntimeError("a mistake")

    with monkeypatch.context() as patch:
        patch.setattr(bench.device.publisher, "publish_state", mistake)
        eventually(lambda: "a mistake" in caplog.text)
    take_control(bench)


def test_what_is_not_for_a_device_is_let_go_and_the_drawing_is_shown(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.driver.twin = lambda: Twin(device="arm", bodies=())  # type: ignore[method-assign]
    bench.device.start()
    bench.device.link_changed(True)
    bench.receive(topics.TELE, b"{}", "joints")
    assert eventually(lambda: bench.heard(topics.DESC, Twin, topics.TWIN)) == [Twin(device="arm", bodies=())]
    assert bench.device.quiet
    assert bench.device.publisher.rejections == {}
    bench.device.stop()
    bench.outbox.stop()
    bench.journal.close()


def test_a_room_that_is_not_known_holds_and_is_shown(tmp_path: Path) -> None:
    rule = InterlockRule(device="sensors-pir", stream="presence", field="present", equals=True)
    bench = Bench(tmp_path, interlocks=(rule,))
    bench.device.start()
    bench.device.link_changed(True)
    (acted,) = eventually(lambda: events(bench, EventKind.INTERLOCK_ENGAGED))
    assert acted.data["interlock"] == rule.name
    (shown,) = eventually(lambda: [state.restrictions for state in bench.heard(topics.STATE, State)][-1:])
    assert [(each.source, each.speed) for each in shown] == [(rule.name, 0.0)]
    assert bench.heard(topics.DESC, Description)[0].interlocks == (rule.description,)
    take_control(bench)
    refused = bench.end(bench.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=1))
    assert refused.status is AckStatus.FAILED
    assert not bench.device._controller.moving
    bench.device.stop()
    bench.outbox.stop()
    bench.journal.close()


def test_a_state_that_the_link_did_not_take_is_told_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    eventually(lambda: bench.heard(topics.STATE, State))
    with monkeypatch.context() as patch:
        patch.setattr(bench.device.publisher, "_publish", lambda *_, **__: False)
        bench.device.link_changed(True)
        time.sleep(0.3)
    before = len(bench.heard(topics.STATE, State))
    eventually(lambda: len(bench.heard(topics.STATE, State)) > before)


def test_an_answer_that_nobody_confirmed_is_given_again_over_the_next_link(bench: Bench) -> None:
    with mock.patch.object(bench.device.publisher, "_delivered"):
        command = bench.command(StopDevice())
        bench.end(command)
    before = len(bench.acks(command))
    bench.device.link_changed(True)
    eventually(lambda: len(bench.acks(command)) > before)


def test_while_a_link_is_young_answers_are_not_believed_to_have_arrived_and_given_once_more(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.outbox.settle_s = 1000.0
    bench.device.start()
    bench.device.link_changed(True)
    command = bench.command(StopDevice())
    answer = bench.end(command)
    time.sleep(0.3)
    assert bench.journal.undelivered("arm") == (answer,)
    bench.device.publisher._acks_valid_from_s = 0.0
    eventually(lambda: bench.acks(command)[-2:] == [answer, answer])
    eventually(lambda: bench.journal.undelivered("arm") == ())
    later = bench.command(StopDevice())
    bench.end(later)
    eventually(lambda: bench.journal.undelivered("arm") == ())
    assert [ack.status for ack in bench.acks(later)] == [AckStatus.DONE]
    bench.device.stop()
    bench.outbox.stop()
    bench.journal.close()
