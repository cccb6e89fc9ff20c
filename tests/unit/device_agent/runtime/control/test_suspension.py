"""Suspension before a restart: only a device at rest agrees, and then it rejects motion until it is resumed."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from device_agent.ports.driver import Observation
from device_agent.protocol import AckStatus, Mode, MoveJoints, ReleaseLease, StopDevice
from device_agent.protocol.commands import GrantLease
from device_agent.runtime.storage.journal import JournalError
from tests.fakes.drivers import FakeDriver
from tests.harness.agent.controller_fixture import ControllerFixture, leased, refuses
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.unit.device_agent.runtime.conftest import MakeDevice
from tests.unit.device_agent.runtime.test_agent import AgentFixture, fixture

__all__ = ["fixture"]
WHY = "the agent is about to restart"
GRANT = GrantLease(holder="ann", lease_ms=60_000)
MOVE = MoveJoints(position_rad={"elbow": 0.5}, speed=1.0)


def end_code(harness: DeviceHarness, request: Any, epoch: int) -> str:
    return harness.end_code(harness.command(request, epoch=epoch))


def test_a_lease_an_action_and_motion_prevent_it_until_they_end() -> None:
    control = leased()
    assert control.controller.suspend(WHY, control.now_s) == "ann has control"
    control.stream(1, 1.0)
    control.controller.release(epoch=1)
    assert control.controller.suspend(WHY, control.now_s) == "it moves"
    control.run(1.0)
    reservation = control.controller.reserve(epoch=2, on_revoked=lambda _: None)
    assert control.controller.suspend(WHY, control.now_s) == "an action runs"
    control.controller.end_reservation(reservation)
    assert control.controller.suspend(WHY, control.now_s) == ""


def test_a_suspended_device_rejects_grants_setpoints_and_actions_and_moves_after_its_resumption() -> None:
    control = ControllerFixture()
    assert control.controller.suspend(WHY, control.now_s) == ""
    with refuses("restarting"):
        control.grant(1)
    with refuses("restarting"):
        control.controller.reserve(epoch=1, on_revoked=lambda _: None)
    control.controller.resume()
    control.grant(2)
    control.stream(2, 1.0)
    assert control.elbow > 0.5


def test_commands_in_the_window_end_with_the_reason_and_a_stop_still_latches(harness: DeviceHarness) -> None:
    assert harness.device.suspend(WHY) == ""
    rejected = harness.end(harness.command(MOVE, epoch=3))
    assert rejected.status is AckStatus.FAILED
    assert rejected.reason is not None
    assert (rejected.reason.code, rejected.reason.message) == ("restarting", WHY)
    assert end_code(harness, GRANT, 4) == "restarting"
    assert harness.driver.position[1] == 0.0
    harness.done(StopDevice(), epoch=0)
    eventually(lambda: harness.telemetry().mode is Mode.STOPPED)
    harness.device.resume()
    assert end_code(harness, MOVE, 5) == "stopped"


def test_a_lease_of_a_whole_device_prevents_it_until_its_release(harness: DeviceHarness) -> None:
    harness.done(GRANT, epoch=1)
    assert harness.device.suspend(WHY) == "ann has control"
    harness.done(ReleaseLease(), epoch=1)
    eventually(lambda: harness.device.suspend(WHY) == "")


def test_an_action_that_has_not_reported_its_end_prevents_it(harness: DeviceHarness) -> None:
    blocked, reported = threading.Event(), harness.device._executor._report

    def report(command: str, status: AckStatus, **rest: Any) -> None:
        if status.terminal:
            blocked.wait(20)
        reported(command, status, **rest)

    harness.device._executor._report = report
    running = harness.running(MOVE, epoch=1)
    eventually(lambda: harness.device.suspend(WHY) == "an action ends")
    blocked.set()
    harness.end(running)
    eventually(lambda: harness.device.suspend(WHY) == "")


class CoastingDriver(FakeDriver):
    """A device that moves without a command, for example because a person pushes it."""

    def observe(self) -> Observation:
        observation = super().observe()
        return replace(observation, velocity_rad_s=tuple(0.3 for _ in observation.velocity_rad_s))


def test_measured_motion_prevents_it_unless_the_device_has_failed(make_device: MakeDevice) -> None:
    driver = CoastingDriver()
    harness = make_device(driver=driver)
    assert harness.device.suspend(WHY) == "a joint moves"
    assert harness.device._controller._state.authority.suspended == ""
    harness.device._controller.set_fault("the cable is unplugged")
    assert harness.device.suspend(WHY) == ""


def test_a_device_that_was_never_measured_agrees(tmp_path: Path) -> None:
    harness = DeviceHarness(tmp_path)
    try:
        assert harness.device.suspend(WHY) == ""
    finally:
        harness.stop()


def test_a_journal_that_cannot_be_written_prevents_it(harness: DeviceHarness, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise JournalError("the journal could not be synced; check the disk")

    monkeypatch.setattr(harness.device, "_sync", fail)
    assert harness.device.suspend(WHY) == "the journal could not be synced; check the disk"
    harness.done(MOVE, epoch=1)


def test_an_agent_is_suspended_only_with_all_its_devices(fixture: AgentFixture) -> None:
    linked = [fixture.agent.linked]
    running = fixture.harness.running(fixture.harness.script("wait(600)"), epoch=1)
    assert fixture.agent.suspend(WHY) == "arm: an action runs"
    fixture.link.link_changed(False)
    linked.append(fixture.agent.linked)
    assert linked == [True, False]
    assert fixture.harness.end_code(running) == "link_lost"
    eventually(lambda: fixture.agent.suspend(WHY) == "")
    fixture.link.link_changed(True)
    assert end_code(fixture.harness, MOVE, 2) == "restarting"
    fixture.agent.resume()
    fixture.harness.done(MOVE, epoch=3)
