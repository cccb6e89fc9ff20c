"""Actions in the recording of a session: when each started and ended, and why."""

from pathlib import Path

import pytest

from device_agent.protocol import Event
from device_agent.runtime.recording.device_recording import DeviceRecording
from device_agent.runtime.recording.recorder import Recorder
from tests.harness.agent.recordings.segments import limits
from tests.unit.device_agent.runtime.conftest import MakeDevice


class RecordedActions:
    """A recorded device, and the events of its actions."""

    def __init__(self, folder: Path, make_device: MakeDevice, monkeypatch: pytest.MonkeyPatch) -> None:
        self.events: list[Event] = []
        monkeypatch.setattr(DeviceRecording, "add_event", lambda _, event: self.events.append(event))
        recorder = Recorder(limits(folder / "recordings"), owner="s/ann")
        self.harness = make_device(recorder=recorder)

    def actions(self) -> list[Event]:
        return [each for each in self.events if each.kind.startswith("action-")]


@pytest.fixture
def recorded(tmp_path: Path, make_device: MakeDevice, monkeypatch: pytest.MonkeyPatch) -> RecordedActions:
    return RecordedActions(tmp_path, make_device, monkeypatch)


def test_an_action_is_recorded_from_its_start_to_its_success(recorded: RecordedActions) -> None:
    ack = recorded.harness.done(recorded.harness.script("print(1)"), epoch=1)
    started, ended = recorded.actions()
    caller = started.data["caller"]
    assert started.data == {"action": ack.id, "task": "run_movement", "name": "dance", "caller": caller}
    assert (started.kind, started.message) == ("action-started", f"action run_movement dance of {caller} started")
    assert (ended.kind, ended.message) == ("action-ended", f"action run_movement dance of {caller} succeeded")
    assert (ended.severity, ended.data) == ("info", {**started.data, "status": "done"})
    assert 0 < started.at_ms <= ended.at_ms


def test_the_end_of_a_failed_action_has_its_reason(recorded: RecordedActions) -> None:
    reason = recorded.harness.failed(recorded.harness.script("1 / 0"), epoch=1)
    ended = recorded.actions()[-1]
    assert (ended.kind, ended.severity) == ("action-ended", "warning")
    assert (ended.data["status"], ended.data["code"]) == ("failed", "script_failed")
    assert reason.message in ended.message
