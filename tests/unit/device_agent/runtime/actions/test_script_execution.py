"""Stop, cancellation, time limits, progress and sandbox state of running scripts."""

from pathlib import Path
from typing import Literal

import msgspec
import pytest

from device_agent.protocol import AckStatus, CancelAction, Description, MoveJoints, RunBehaviour, topics
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.agent.sandbox import LACK, NoSandbox
from tests.unit.device_agent.runtime.actions.robot_api_fixture import driver_of
from tests.unit.device_agent.runtime.conftest import MakeDevice


def test_stop_ends_a_skill_and_the_script(harness: DeviceHarness) -> None:
    running = harness.command(harness.script("robot.behaviour('dance')\nrobot.say('still here')"), epoch=1)
    eventually(lambda: driver_of(harness).performed)
    harness.receive_stop()
    assert harness.end_code(running) == "stopped"
    assert driver_of(harness).interrupted.wait(10)
    assert driver_of(harness).performed == [RunBehaviour(name="dance")]


@pytest.mark.parametrize("name", ["dance", "sulk"])
def test_a_cancel_ends_a_skill(harness: DeviceHarness, name: str) -> None:
    running = harness.command(harness.script(f"robot.behaviour('{name}')"), epoch=1)
    eventually(lambda: driver_of(harness).performed)
    harness.command(CancelAction(action=running))
    assert harness.end(running).status is AckStatus.CANCELLED


def test_a_script_times_out(harness: DeviceHarness) -> None:
    request = msgspec.structs.replace(harness.script("print('started')\nwait(600)"), timeout_ms=300)
    reason = harness.failed(request, epoch=1)
    assert reason.code == "too_long"
    assert "after its 0.3 s" in reason.message


@pytest.mark.slow
def test_progress_and_output_are_acknowledged_while_it_runs(harness: DeviceHarness) -> None:
    source = "for i in range(4):\n  progress(i / 4)\n  print('part', i)\n  wait(0.25)\n"
    ended = harness.done(harness.script(source), epoch=1)
    started = [ack for ack in harness.acks(ended.id) if ack.status is AckStatus.STARTED]
    assert len({ack.progress for ack in started}) > 2
    assert any("part 0" in ack.output and "part 3" not in ack.output for ack in started)


def test_an_older_version_does_not_run_again(harness: DeviceHarness) -> None:
    harness.done(harness.script("print(2)", version=2), epoch=1)
    assert harness.failed(harness.script("print(1)", version=1), epoch=1).code == "rolled_back"


def test_a_script_of_another_account_runs_behind_bubblewrap(harness: DeviceHarness) -> None:
    source = "import os\nprint(os.getpid())"
    own = int(harness.done(harness.script(source), epoch=1).output)
    foreign = int(harness.done(harness.script(source, author="accountbbbbbbbbb"), epoch=1).output)
    children = [int(child) for task in Path("/proc/self/task").glob("*/children") for child in task.read_text().split()]
    # Process ids wrap around, so an absolute limit proves nothing.
    assert foreign < min(own, *children), "it sees only process ids of its own namespace"


def test_a_result_contains_the_limits(harness: DeviceHarness) -> None:
    harness.device._controller.restrict("room", 0.2, "a person is near")
    ack = harness.done(MoveJoints(position_rad={"elbow": 0.05}, speed=1.0), epoch=1)
    assert ack.result["limited"] == ["interlock: a person is near"]


@pytest.mark.parametrize("mode", ["unavailable", "unconfined"])
def test_a_missing_sandbox_is_described_and_scripts_are_rejected(
    make_device: MakeDevice, mode: Literal["unavailable", "unconfined"]
) -> None:
    harness = make_device(sandbox=NoSandbox(mode))
    described: Description = eventually(lambda: harness.published(topics.DESC, Description))[0]
    assert (described.scripts, described.scripts_note) == (mode, LACK)
    eventually(lambda: harness.events(f"scripts-{mode}"))
    reason = harness.failed(harness.script("print(1)"), epoch=1)
    assert (reason.code, reason.message) == ("no_sandbox", LACK)
