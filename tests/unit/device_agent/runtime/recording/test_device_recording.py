"""Which control periods and messages are recorded, and what is shown about it."""

import msgspec
import pytest

from device_agent.protocol import Event, Mode
from device_agent.protocol.events import EventKind
from device_agent.runtime.recording import device_recording as module
from device_agent.runtime.recording.format import Source
from device_agent.runtime.recording.messages import RecordedFrame, RecorderStatus
from tests.harness.agent.recordings.device import MEASURED, Recorded


@pytest.fixture
def recorded() -> Recorded:
    return Recorded()


def test_periods_with_a_lease_are_recorded_with_their_metadata(recorded: Recorded) -> None:
    recorded.run(3, epoch=0)
    recorded.run(2, mode=Mode.STREAMING, requested_rad=(0.3, 0.4), seen_tick_ms=77)
    batch = recorded.take()[0]
    info = batch.session
    assert info is not None
    assert (info.device, info.epoch, info.holder, info.joints) == ("arm", 7, "holder of 7", ("shoulder", "elbow"))
    assert (info.segment, info.period_ms, info.robot_type, info.simulated) == (0, 8, "test", True)
    first = batch.rows[0]
    assert first.tick_ns == info.started_tick_ns
    assert [row.sequence for row in batch.rows] == [0, 1]
    assert (first.position_rad, first.requested_rad) == ((0.0, 0.1), (0.3, 0.4))
    assert (first.commanded_rad, first.applied_rad, first.twist) == ((0.1, 0.2), (0.1, 0.15), (1, 2, 3))
    assert (first.source, first.setpoint_sequence, first.seen_tick_ms) == (Source.OPERATOR, 5, 77)
    assert (first.loop_age_ms, first.limited, first.epoch) == (12.0, ("elbow: range",), 7)


@pytest.mark.parametrize(
    ("mode", "source"),
    [
        (Mode.ACTION, Source.MOVEMENT),
        (Mode.STOPPED, Source.STOP),
        (Mode.HOLDING, Source.HOLD),
        (Mode.IDLE, Source.HOLD),
    ],
)
def test_without_an_operator_a_row_has_no_setpoint(recorded: Recorded, mode: Mode, source: Source) -> None:
    recorded.run(mode=mode, seen_tick_ms=77)
    row = recorded.rows()[0]
    assert (row.source, row.setpoint_sequence, row.seen_tick_ms, row.loop_age_ms) == (source, 0, 0, 0.0)
    assert row.requested_rad == row.commanded_rad


def test_an_action_without_a_lease_is_recorded(recorded: Recorded) -> None:
    recorded.action_epoch = 9
    recorded.run(2, mode=Mode.ACTION, epoch=0)
    assert [row.mode for row in recorded.rows()] == [Mode.ACTION] * 2
    recorded.run(round(module.PAUSE_S / 0.008) + 1, epoch=0)
    batch = recorded.take()[-1]
    assert batch.session is not None
    assert (batch.session.epoch, batch.ended) == (9, True)


def test_a_pause_within_an_action_does_not_split_the_session(recorded: Recorded) -> None:
    recorded.action_epoch = 9
    recorded.run(2, mode=Mode.ACTION, epoch=0)
    recorded.run(3, epoch=0)
    recorded.run(2, mode=Mode.ACTION, epoch=0)
    (batch,) = recorded.take()
    assert ([row.sequence for row in batch.rows], batch.ended) == ([0, 1, 2, 3, 4, 5, 6], False)


def test_a_moving_robot_is_recorded_until_it_rests(recorded: Recorded) -> None:
    recorded.run(2)
    recorded.run(3, epoch=0, moving=True)
    recorded.run(3, epoch=0)
    batch = recorded.take()[0]
    assert ([row.epoch for row in batch.rows], batch.ended) == ([7] * 5, True)


def test_a_robot_that_never_rests_is_recorded_for_some_seconds(recorded: Recorded) -> None:
    recorded.run()
    recorded.run(1000, epoch=0, moving=True)
    assert len(recorded.rows()) == pytest.approx(module.AFTER_S / 0.008, abs=2)


def test_a_new_lease_is_a_new_session(recorded: Recorded) -> None:
    recorded.run(2)
    recorded.run(2, epoch=8)
    first, second = recorded.take()
    assert (first.ended, second.ended) == (True, False)
    assert [row.sequence for row in second.rows] == [0, 1]
    assert second.session is not None
    assert second.session.epoch == 8


def test_a_full_queue_drops_rows_which_shows_as_a_gap(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_QUEUED", 4)
    recorded.run(10)
    recorded.device.add_measurements("health", MEASURED)
    assert [row.sequence for row in recorded.rows()] == [0, 1, 2]
    recorded.run(1)
    assert [row.sequence for row in recorded.rows()] == [10]


def test_events_and_measurements_of_the_session_are_recorded(recorded: Recorded) -> None:
    recorded.device.add_measurements("health", MEASURED)
    recorded.run()
    event = Event(id="e", device="arm", at_ms=5, kind="stop-latched", severity="info", message="")
    recorded.device.add_event(event)
    recorded.device.add_measurements("health", MEASURED)
    recorded.device.add_reading("agent-door", "door", MEASURED)
    recorded.device.add_reading("agent-arm", "health", MEASURED)
    entries = recorded.take()[0].entries
    assert [(each.topic, each.schema, each.at_ms) for each in entries] == [
        ("/events", "Event", 5),
        ("/measurements/health", "Measurements", 2),
        ("/room/agent-door/door", "Measurements", 2),
    ]
    assert msgspec.json.decode(entries[0].data, type=Event) == event


@pytest.mark.parametrize(("earlier_s", "recorded_events"), [(0.5, 1), (2.0, 0)])
def test_the_event_of_a_grant_belongs_to_the_session_that_begins_after_it(
    recorded: Recorded, earlier_s: float, recorded_events: int
) -> None:
    recorded.device.add_event(Event(id="e", device="arm", at_ms=5, kind="lease-granted", severity="info", message=""))
    recorded.now_s += earlier_s
    recorded.run()
    (batch,) = recorded.take()
    assert len(batch.entries) == recorded_events
    assert batch.session is not None
    assert all(entry.tick_ns >= batch.session.started_tick_ns for entry in batch.entries)


def test_batches_are_small(recorded: Recorded) -> None:
    recorded.run(100)
    assert [len(batch.rows) for batch in recorded.take()] == [64, 36]


def test_a_recording_is_active_only_while_rows_are_confirmed(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = [recorded.device.active]
    recorded.run()
    shown.append(recorded.device.active)
    recorded.take()
    shown.append(recorded.device.active)
    recorded.run()
    recorded.take(RecorderStatus(error="full"))
    shown.append(recorded.device.active)
    recorded.run()
    recorded.take()
    shown.append(recorded.device.active)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_STALE_S", 0.0)
        shown.append(recorded.device.active)
    recorded.run(epoch=0)
    shown.append(recorded.device.active)
    assert shown == [False, False, True, False, True, False, False]


def test_a_failure_is_a_fault_and_one_event_until_recording_resumes(recorded: Recorded) -> None:
    assert recorded.device.faults() == ()
    for _ in range(3):
        recorded.run()
        recorded.take(RecorderStatus(error="the disk is full", segment=2))
    fault = recorded.device.faults()[0]
    assert (fault.code, fault.message) == ("recording", "the disk is full")
    recorded.run()
    batches = recorded.take(RecorderStatus(segment=3))
    assert batches[0].session is not None
    assert batches[0].session.segment == 2
    assert recorded.device.faults() == ()
    assert recorded.kinds() == [EventKind.RECORDING_FAILED, EventKind.RECORDING_RESUMED]
    assert recorded.events[0].data == {"epoch": 7}


def test_a_failure_between_sessions_is_no_fault(recorded: Recorded) -> None:
    recorded.device.fail("the process has ended")
    recorded.run()
    assert (recorded.device.faults(), recorded.events) == ((), [])


def test_a_recorder_that_does_not_respond_is_a_fault(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded.take()
    recorded.run()
    assert recorded.device.faults() == ()
    monkeypatch.setattr(module, "_SILENT_S", -1.0)
    assert "does not respond" in recorded.device.faults()[0].message


def frame(tick_s: float) -> RecordedFrame:
    return RecordedFrame("/frames/front", round(tick_s * 1e9), 5, b"jpeg")


def recorded_frames(recorded: Recorded) -> list[RecordedFrame]:
    return [each for batch in recorded.take() for each in batch.frames]


def test_only_frames_of_the_session_are_recorded(recorded: Recorded) -> None:
    recorded.device.add_frame(frame(recorded.now_s), lambda: True)
    started_s = recorded.now_s
    recorded.run()
    recorded.device.add_frame(frame(started_s - 0.1), lambda: True)
    recorded.device.add_frame(frame(started_s + 0.1), lambda: True)
    recorded.device.add_frame(frame(started_s + 0.2), lambda: False)
    assert [each.tick_ns for each in recorded_frames(recorded)] == [frame(started_s + 0.1).tick_ns]


def test_a_frame_that_arrives_after_the_end_is_in_no_session(recorded: Recorded) -> None:
    recorded.run()
    waiting = module._Frame(frame(recorded.now_s), lambda: True)
    recorded.device.end()
    recorded.device._queue.append(waiting)
    recorded.device._free_frames.acquire()
    recorded.now_s += 1.0
    recorded.run(epoch=8)
    assert recorded_frames(recorded) == []


def test_frames_are_dropped_while_too_many_wait(recorded: Recorded) -> None:
    recorded.run()
    for _ in range(2):
        for number in range(module.MAX_FRAMES + 5):
            recorded.device.add_frame(frame(recorded.now_s + number), lambda: True)
        assert len(recorded_frames(recorded)) == module.MAX_FRAMES
