"""A device with failing code, driver or disk: it holds, reports the error and ends every command."""

import errno
import os
import threading
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from device_agent.ports.driver import DriverError, Observation
from device_agent.protocol import Ack, AckStatus, Event, Mode, MoveJoints, topics
from device_agent.runtime.actions.robot_api import RobotApi
from device_agent.runtime.commands import command_processor
from device_agent.runtime.commands.command_processor import CommandProcessor
from device_agent.runtime.errors import INTERNAL_ERROR
from device_agent.runtime.storage.journal import Journal, JournalError
from tests.harness.agent.device_harness import DeviceHarness, eventually

MOVE = MoveJoints(position_rad={"elbow": 0.1}, speed=1.0)


def broken(*_: Any, **__: Any) -> Any:
    raise ZeroDivisionError("a bug")


def test_an_unexpected_error_fails_the_action_or_command_and_the_next_one_runs(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    for owner, name in ((RobotApi, "move_joints"), (CommandProcessor, "_apply")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, broken)
            assert harness.failed(MOVE, epoch=1).code == "internal"
        harness.done(MOVE, epoch=1)


def test_a_command_whose_epoch_cannot_be_journalled_is_not_applied(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise JournalError("is the disk full?")

    monkeypatch.setattr(Journal, "save_epoch", full)
    command = harness.command(MOVE, epoch=7)
    eventually(lambda: [event for event in harness.published(topics.EVENT, Event) if "disk" in event.message])
    assert {ack.status for ack in harness.acks(command)} <= {AckStatus.RECEIVED}
    assert harness.driver.position == (0.0, 0.0)
    monkeypatch.undo()


def test_nothing_moves_if_the_journal_cannot_be_written(
    harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = Journal.record

    def full(journal: Journal, ack: Ack) -> None:
        if ack.status is AckStatus.STARTED:
            raise JournalError("is the disk full?")
        record(journal, ack)

    def fails(_: int) -> None:
        raise OSError(errno.EIO, "I/O error")

    changes: tuple[tuple[Any, str, Any], ...] = ((Journal, "record", full), (os, "fsync", fails))
    for owner, name, failure in changes:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, failure)
            assert harness.failed(MOVE, epoch=1).code == "internal"
    assert harness.driver.position == (0.0, 0.0)
    harness.done(MOVE, epoch=1)


def test_an_unexpected_error_in_the_control_loop_is_a_fault(harness: DeviceHarness) -> None:
    with mock.patch.object(harness.driver, "observe", broken):
        eventually(lambda: harness.device._controller.fault == INTERNAL_ERROR)
    eventually(lambda: harness.telemetry().mode is Mode.IDLE and harness.device._controller.fault is None)


def test_an_unexpected_error_of_a_reconnection_does_not_end_the_control_loop(harness: DeviceHarness) -> None:
    failed: list[object] = []

    def connect() -> None:
        failed.append(None)
        raise ZeroDivisionError("a bug")

    with mock.patch.object(harness.driver, "observe", broken), mock.patch.object(harness.driver, "connect", connect):
        eventually(lambda: len(failed) >= 2)
        assert harness.device._controller.fault == INTERNAL_ERROR
    eventually(lambda: harness.telemetry().mode is Mode.IDLE and harness.device._controller.fault is None)


def test_a_recurring_error_of_the_control_loop_is_logged_once(
    harness: DeviceHarness, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_processor, "FAULT_STABLE_S", 1000.0)
    failed_sends: list[object] = []

    def fail(position_rad: object) -> None:
        failed_sends.append(position_rad)
        raise ZeroDivisionError("a bug")

    with mock.patch.object(harness.driver, "send", fail):
        eventually(lambda: len(failed_sends) >= 3)
    assert len([record for record in caplog.records if record.exc_info]) == 1


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


def test_shutdown_ends_the_running_action_and_waits_for_rest(harness: DeviceHarness) -> None:
    running = harness.command(MoveJoints(position_rad={"elbow": 2.5}, speed=1.0), epoch=1)
    eventually(lambda: harness.device._controller.moving)
    harness.device.stop()
    assert harness.end_code(running) == "agent_stopping"
    assert not harness.device._controller.moving


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
