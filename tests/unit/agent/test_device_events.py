"""Every change of authority at a device and every refusal leaves an event."""

import sqlite3
from pathlib import Path
from typing import Any

import pytest

from device_agent.protocol import codec, signing, topics
from device_agent.protocol.events import EventKind
from device_agent.protocol.messages import (
    AckStatus,
    Event,
    GrantLease,
    MoveJoints,
    ReleaseLease,
    ResetStop,
    Stop,
    StopDevice,
)
from tests.unit.agent.test_device import Bench, eventually


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
    assert "ran out" in ended.message


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
        bench.receive(topics.STOP, codec.encode(Stop(id="s1", by="cat", reason="smoke")))
    assert bench.end(command).status is AckStatus.FAILED
    assert event(bench, EventKind.STOP_LATCHED).data == {"by": "cat", "reason": "smoke"}
    assert event(bench, EventKind.HELD).data == {"code": "stopped", "epoch": 1}
    assert event(bench, EventKind.ACTION_LOST).data == {"code": "stopped", "epoch": 1}
    assert event(bench, EventKind.LEASE_ENDED).data["code"] == "stopped"
    bench.end(bench.command(ResetStop(), epoch=2))
    assert event(bench, EventKind.STOP_RESET).data == {"by": "ann"}
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
    refused = event(bench, EventKind.SETPOINTS_REFUSED)
    assert refused.data == {"code": "no_lease"}
    assert refused.severity == "warning"
    bench.device.stop()
    eventually(lambda: len(events(bench, EventKind.SETPOINTS_REFUSED)) == 2)
    first, rest = events(bench, EventKind.SETPOINTS_REFUSED)
    assert (first.id, rest.data) == (refused.id, {"code": "no_lease", "count": 199})


def test_refused_commands_are_told_with_what_could_be_read(bench: Bench) -> None:
    bench.receive(topics.CMD, signing.sign(b"{}", signing.generate()))
    assert event(bench, EventKind.COMMAND_REFUSED).data == {"code": "bad_signature"}
    bench.command(StopDevice(reason=""), device="other")
    eventually(lambda: events(bench, EventKind.COMMAND_REFUSED)[-1].data["code"] == "wrong_address")
    command = bench.command(MoveJoints(position_rad={"elbow": 1.0}), epoch=3, issued_at_ms=1)
    bench.end(command)
    expected = {"code": "expired", "command": command, "request": "move_joints", "who": "ann", "epoch": 3}
    eventually(lambda: events(bench, EventKind.COMMAND_REFUSED)[-1].data == expected)
    signed = signing.sign(b"{}", bench.key)
    bench.receive(topics.CMD, signed)
    eventually(lambda: events(bench, EventKind.COMMAND_REFUSED)[-1].data == {"code": "malformed"})


def test_a_stop_that_cannot_be_read_is_told(bench: Bench) -> None:
    bench.receive(topics.STOP, b"stop!")
    assert event(bench, EventKind.STOP_REFUSED).data == {"code": "malformed"}


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
