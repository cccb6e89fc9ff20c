"""Stop, cancellation, time limits, progress and sandbox state of running scripts."""

from pathlib import Path
from typing import Literal

import msgspec
import pytest

from device_agent.protocol import (
    AckStatus,
    CancelAction,
    Description,
    Event,
    MoveJoints,
    RunBehaviour,
    Stop,
    topics,
)
from tests.harness.agent.device_harness import DeviceHarness, eventually
from tests.harness.agent.sandbox import LACK, NoSandbox
from tests.unit.device_agent.runtime.actions.robot_api_fixture import driver_of


def test_stop_ends_a_skill_and_the_script(harness: DeviceHarness) -> None:
    running = harness.command(harness.script("robot.behaviour('dance')\nrobot.say('still here')"), epoch=1)
    eventually(lambda: driver_of(harness).performed)
    harness.receive(topics.STOP, msgspec.json.encode(Stop(id="s1", caller="bob", reason="smoke")))
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
    order = msgspec.structs.replace(harness.script("print('started')\nwait(600)"), timeout_ms=300)
    ack = harness.end(harness.command(order, epoch=1))
    assert ack.reason is not None
    assert (ack.status, ack.reason.code) == (AckStatus.FAILED, "too_long")
    assert "after its 0.3 s" in ack.reason.message


def test_progress_and_output_are_acknowledged_while_it_runs(harness: DeviceHarness) -> None:
    source = "for i in range(4):\n    progress(i / 4)\n    print('part', i)\n    wait(0.25)\n"
    running = harness.command(harness.script(source), epoch=1)
    harness.end(running)
    told = [ack for ack in harness.acks(running) if ack.status is AckStatus.STARTED]
    assert len({ack.progress for ack in told}) > 2
    assert any("part 0" in ack.output and "part 3" not in ack.output for ack in told)


def test_an_older_version_does_not_run_again(harness: DeviceHarness) -> None:
    assert harness.end(harness.command(harness.script("print(2)", version=2), epoch=1)).status is AckStatus.DONE
    assert harness.end_code(harness.command(harness.script("print(1)", version=1), epoch=1)) == "rolled_back"


def test_a_script_of_another_account_runs_behind_bubblewrap(harness: DeviceHarness) -> None:
    source = "import os\nprint(os.getpid())"
    own = int(harness.end(harness.command(harness.script(source), epoch=1)).output)
    strange = int(harness.end(harness.command(harness.script(source, author="accountbbbbbbbbb"), epoch=1)).output)
    parents = [
        int(process) for task in Path("/proc/self/task").glob("*/children") for process in task.read_text().split()
    ]
    # The machine's numbers come round again, so they say nothing about each other.
    assert strange < min(own, *parents), "it does not see process ids of its own"


def test_a_result_contains_the_limits(harness: DeviceHarness) -> None:
    harness.device._controller.restrict("room", 0.2, "a person is near")
    ack = harness.end(harness.command(MoveJoints(position_rad={"elbow": 0.05}, speed=1.0), epoch=1))
    assert ack.status is AckStatus.DONE
    assert ack.result["limited"] == ["interlock: a person is near"]


@pytest.mark.parametrize("how", ["unavailable", "unconfined"])
def test_a_missing_sandbox_is_described_and_scripts_are_rejected(
    tmp_path: Path, how: Literal["unavailable", "unconfined"]
) -> None:
    harness = DeviceHarness(tmp_path, sandbox=NoSandbox(how))
    harness.start()
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert (described.scripts, described.scripts_note) == (how, LACK)
    eventually(lambda: [event for event in harness.heard(topics.EVENT, Event) if event.kind == f"scripts-{how}"])
    reason = harness.end(harness.command(harness.script("print(1)"), epoch=1)).reason
    assert reason is not None
    assert (reason.code, reason.message) == ("no_sandbox", LACK)
    harness.stop()


def test_desc_reports_the_sandbox(harness: DeviceHarness) -> None:
    described: Description = eventually(lambda: harness.heard(topics.DESC, Description))[0]
    assert (described.scripts, described.scripts_note) == ("sandboxed", "")
