"""A device with failing code, driver or disk: it holds, reports the error and ends every command."""

import errno
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.driver import DriverError, Observation
from device_agent.protocol import Ack, AckStatus, Event, GrantLease, Mode, MoveJoints, topics
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.commands import command_processor
from device_agent.runtime.commands.command_processor import CommandProcessor
from device_agent.runtime.storage.journal import Journal, JournalError
from tests.harness.agent.device_harness import DeviceHarness, eventually

MOVE = MoveJoints(position_rad={"elbow": 0.1}, speed=1.0)


def broken(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("a bug")


def code(harness: DeviceHarness, command: str) -> str:
    ack = harness.end(command)
    assert ack.status is AckStatus.FAILED
    assert ack.reason is not None
    return ack.reason.code


def test_an_unexpected_error_fails_the_action_and_the_next_one_runs(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RobotApi, "move_joints", broken)
    assert code(harness, harness.command(MOVE, epoch=1)) == "internal"
    monkeypatch.undo()
    assert harness.end(harness.command(MOVE, epoch=1)).status is AckStatus.DONE


def test_an_unexpected_error_fails_the_command(harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommandProcessor, "_apply", broken)
    assert code(harness, harness.command(GrantLease(holder="ann", lease_ms=1000), epoch=1)) == "internal"


def test_a_command_whose_epoch_cannot_be_journalled_is_not_applied(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise JournalError("is the disk full?")

    monkeypatch.setattr(Journal, "save_epoch", full)
    command = harness.command(MOVE, epoch=7)
    eventually(lambda: [event for event in harness.heard(topics.EVENT, Event) if "disk" in event.message])
    assert {ack.status for ack in harness.acks(command)} <= {AckStatus.RECEIVED}
    assert harness.driver.position == (0.0, 0.0)
    monkeypatch.undo()


@pytest.mark.parametrize("what", ["its start cannot be journalled", "the disk does not take it"])
def test_nothing_moves_if_the_journal_cannot_be_written(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    record = Journal.record

    def full(journal: Journal, ack: Ack) -> None:
        if ack.status is AckStatus.STARTED:
            raise JournalError("is the disk full?")
        record(journal, ack)

    def fails(_: int) -> None:
        raise OSError(errno.EIO, "I/O error")

    if what.startswith("its start"):
        monkeypatch.setattr(Journal, "record", full)
    else:
        monkeypatch.setattr(os, "fsync", fails)
    assert code(harness, harness.command(MOVE, epoch=1)) == "internal"
    assert harness.driver.position == (0.0, 0.0)
    monkeypatch.undo()
    assert harness.end(harness.command(MOVE, epoch=1)).status is AckStatus.DONE


def test_an_unexpected_error_in_the_control_loop_is_a_fault(harness: DeviceHarness) -> None:
    whole = harness.driver.observe
    harness.driver.observe = broken  # type: ignore[method-assign]
    eventually(lambda: harness.device._controller.fault == "internal error: a bug")
    harness.driver.observe = whole  # type: ignore[method-assign]
    eventually(lambda: harness.telemetry().mode is Mode.IDLE and harness.device._controller.fault is None)


def test_commands_beyond_the_queue_are_rejected(harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> None:
    busy, go_on = threading.Event(), threading.Event()

    def wait(*_: Any) -> None:
        busy.set()
        go_on.wait(20)

    monkeypatch.setattr(CommandProcessor, "_process", wait)
    harness.receive(topics.CMD, b"{}")
    assert busy.wait(10)
    for _ in range(command_processor._MAX_WAITING + 3):
        harness.receive(topics.CMD, b"{}")
    assert harness.device.publisher.rejections == {"overrun": 3}
    go_on.set()


def test_shutdown_ends_the_running_action(harness: DeviceHarness) -> None:
    running = harness.command(harness.script("wait(600)"), epoch=1)
    eventually(lambda: harness.acks(running)[1:])
    harness.device.stop()
    assert code(harness, running) == "agent_stopping"


def test_shutdown_waits_for_rest(harness: DeviceHarness) -> None:
    harness.command(MoveJoints(position_rad={"elbow": 2.5}, speed=1.0), epoch=1)
    eventually(lambda: harness.device._controller.moving)
    harness.device.stop()
    assert not harness.device._controller.moving


def test_a_device_that_never_started_can_be_stopped(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.device.stop()
    harness.stop()


def test_a_missing_driver_fails_the_start(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    harness.driver.broken = True
    with pytest.raises(DriverError, match="switched on"):
        harness.device.start()
    harness.stop()


def test_shutdown_works_during_a_fault(harness: DeviceHarness) -> None:
    harness.driver.broken = True
    eventually(lambda: harness.device._controller.fault)
    harness.device.stop()
    assert isinstance(harness.device._loop.observation, Observation)
