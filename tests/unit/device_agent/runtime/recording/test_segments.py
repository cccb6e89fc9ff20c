"""Segments: live files that any reader opens, sealing, recovery of cut and damaged files, and overviews."""

import errno
import json
import os
import random
import stat
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace

from device_agent.protocol import Event
from device_agent.runtime.recording import sealing
from device_agent.runtime.recording.folder import overview_of
from device_agent.runtime.recording.format import (
    EVENTS,
    MAX_EVENT_TEXT,
    MAX_OVERVIEW_EVENTS,
    METADATA,
    CompressedImage,
    Overview,
    OverviewEvent,
)
from device_agent.runtime.recording.live_segment import LiveSegment, decode_info
from device_agent.runtime.recording.messages import Entry, RecordedFrame
from tests.harness.agent.recordings.segments import (
    STARTED_NS,
    STARTED_TICK_NS,
    control_row,
    control_rows,
    live_sequences,
    sealed_messages,
    session,
)


@pytest.fixture
def live(tmp_path: Path) -> LiveSegment:
    return LiveSegment(tmp_path / "0000.live", session())


def sealed(live: LiveSegment) -> Path:
    sealing.seal(live.path)
    return live.path.with_suffix(".mcap")


def event(sequence: int, **changes: Any) -> Entry:
    content = Event(id="e", device="arm", at_ms=5, kind="stop-latched", severity="info", message="stopped")
    content = replace(content, **changes)
    tick_ns = STARTED_TICK_NS + sequence * 8_000_000
    return Entry(EVENTS, "Event", tick_ns, 5, msgspec.json.encode(content))


def test_a_segment_that_is_being_written_can_be_read(live: LiveSegment) -> None:
    live.write(control_rows(0, 5), [event(2)])
    live.sync()
    assert live_sequences(live.path) == [0, 1, 2, 3, 4]


def test_a_sealed_segment_has_all_messages_its_metadata_and_schemas(live: LiveSegment) -> None:
    live.write(control_rows(0, 500), [event(2)])
    path = sealed(live)
    assert [row["sequence"] for row in sealed_messages(path)] == list(range(500))
    assert sealed_messages(path, EVENTS)[0]["message"] == "stopped"
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = next(iter(reader.iter_metadata()))
        first = next(reader.iter_messages(log_time_order=True))
    assert summary is not None
    assert {schema.name for schema in summary.schemas.values()} == {"telescope.ControlRow", "telescope.Event"}
    assert all(json.loads(schema.data)["$ref"] for schema in summary.schemas.values())
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    assert metadata.name == METADATA
    assert decode_info(metadata.metadata) == session()
    assert first[2].log_time == STARTED_NS
    assert first[2].publish_time == STARTED_NS
    assert not live.path.exists()


def test_frames_are_images_at_the_time_of_their_exposure(live: LiveSegment) -> None:
    jpeg = b"\xff\xd8 a picture"
    live.write(control_rows(0, 3), [])
    live.write([], [], [RecordedFrame("/frames/room-door/front", STARTED_TICK_NS + 1_500_000_001, 77, jpeg)])
    path = sealed(live)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        ((schema, channel, message),) = reader.iter_messages(topics=["/frames/room-door/front"])
        metadata = next(iter(reader.iter_metadata())).metadata
    assert schema is not None
    assert (schema.name, channel.message_encoding) == ("foxglove.CompressedImage", "json")
    assert "$ref" not in json.loads(schema.data)
    assert (message.log_time, message.publish_time) == (STARTED_NS + 1_500_000_001, 77_000_000)
    image = msgspec.json.decode(message.data, type=CompressedImage)
    assert (image.data, image.format, image.frame_id) == (jpeg, "jpeg", "front")
    assert image.timestamp.sec * 10**9 + image.timestamp.nsec == message.log_time
    assert decode_info(metadata).cameras == sealing.describe(path).cameras == ("/frames/room-door/front",)


def test_only_this_user_can_read_recordings(live: LiveSegment) -> None:
    live.write(control_rows(0, 1), [])
    modes = [stat.S_IMODE(live.path.stat().st_mode)]
    path = sealed(live)
    modes += [stat.S_IMODE(each.stat().st_mode) for each in (path, overview_of(path))]
    assert modes == [0o600] * 3


def test_the_description_contains_begin_end_and_rows(live: LiveSegment) -> None:
    live.write(control_rows(0, 126), [event(0)])
    summary = sealing.describe(sealed(live))
    start_ms = STARTED_NS // 1_000_000
    assert (summary.started_ms, summary.ended_ms, summary.rows) == (start_ms, start_ms + 1000, 126)


def test_a_changed_wall_clock_does_not_reorder_a_recording(live: LiveSegment) -> None:
    rows = [control_row(sequence, at_ms=10**12 - sequence * 3_600_000) for sequence in range(10)]
    live.write(rows, [])
    with sealed(live).open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert len(set(times)) == 10


def test_what_was_measured_before_the_session_belongs_to_its_start(live: LiveSegment) -> None:
    live.write([control_row(0, tick_ns=0)], [])
    assert sealing.describe(sealed(live)).started_ms == STARTED_NS // 1_000_000


def test_a_segment_cut_anywhere_keeps_every_whole_row(tmp_path: Path) -> None:
    whole = LiveSegment(tmp_path / "whole.live", session())
    sizes = [whole.path.stat().st_size]
    for sequence in range(20):
        whole.write([control_row(sequence)], [])
        sizes.append(whole.path.stat().st_size)
    content = whole.path.read_bytes()
    cuts = random.Random(4).sample(range(sizes[1], len(content)), 25)  # noqa: S311 (a sample of cuts)
    for number, cut in enumerate(cuts):
        path = tmp_path / f"{number}.live"
        path.write_bytes(content[:cut])
        sealing.seal(path)
        expected = sum(size <= cut for size in sizes[1:])
        assert [row["sequence"] for row in sealed_messages(path.with_suffix(".mcap"))] == list(range(expected))


@pytest.mark.parametrize("tail", [b"\0" * 4096, bytes(range(1, 256)) * 16, b"\xff" * 40])
def test_a_damaged_tail_is_cut(live: LiveSegment, tail: bytes) -> None:
    live.write(control_rows(0, 3), [])
    with live.path.open("ab") as file:
        file.write(tail)
    assert [row["sequence"] for row in sealed_messages(sealed(live))] == [0, 1, 2]


def message_record(channel: int, data: bytes) -> bytes:
    body = channel.to_bytes(2, "little") + bytes(4 + 8 + 8) + data
    return b"\x05" + len(body).to_bytes(8, "little") + body


@pytest.mark.parametrize(
    "record",
    [message_record(9, b"{}"), message_record(1, b"{"), message_record(2, b"{"), b"\x0f" + bytes(8) + bytes(4)],
)
def test_messages_after_an_invalid_record_are_cut(live: LiveSegment, record: bytes) -> None:
    live.write(control_rows(0, 3), [event(0)])
    os.write(live.descriptor, record)
    live.write(control_rows(3, 3), [])
    assert [row["sequence"] for row in sealed_messages(sealed(live))] == [0, 1, 2]


def test_a_segment_without_a_row_is_deleted(live: LiveSegment) -> None:
    assert not sealed(live).exists()
    assert list(live.path.parent.iterdir()) == []


def test_an_interrupted_seal_is_repeated_or_completed(live: LiveSegment) -> None:
    live.write(control_rows(0, 3), [])
    content = live.path.read_bytes()
    path = live.path.with_suffix(".mcap")
    path.with_name("0000.mcap.new").write_bytes(b"half of a file")
    sealing.seal(live.path)
    first = path.read_bytes()
    live.path.write_bytes(content)  # killed between the exchange and the deletion
    sealing.seal(live.path)
    assert (path.read_bytes(), live.path.exists()) == (first, False)


def test_a_full_disk_leaves_the_segment_for_a_later_attempt(live: LiveSegment, monkeypatch: pytest.MonkeyPatch) -> None:
    live.write(control_rows(0, 3), [])

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(OSError, match="No space"):
            sealing.seal(live.path)
    assert [path.name for path in live.path.parent.iterdir()] == ["0000.live"]
    assert len(sealed_messages(sealed(live))) == 3


def test_a_locked_segment_is_not_recovered(live: LiveSegment, tmp_path: Path) -> None:
    assert sealing.lock(live.path) is None
    assert sealing.lock(tmp_path / "missing") is None
    os.close(live.descriptor)
    descriptor = sealing.lock(live.path)
    assert descriptor is not None
    os.close(descriptor)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"no recording at all" * 100])
def test_a_damaged_sealed_segment_is_an_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "0000.mcap"
    path.write_bytes(content)
    with pytest.raises(OSError, match=r"damaged|Invalid"):
        sealing.describe(path)


def test_a_segment_without_an_index_is_an_error(live: LiveSegment) -> None:
    live.write(control_rows(0, 3), [])
    with live.path.open("ab") as file:
        writer = Writer(file, use_chunking=False, use_statistics=False)
        writer.finish()
    with pytest.raises(OSError, match="damaged"):
        sealing.describe(live.path)


def test_the_overview_has_five_samples_a_second_and_none_in_a_gap(live: LiveSegment) -> None:
    live.write([*control_rows(0, 125), *control_rows(1000, 125)], [])
    overview = msgspec.json.decode(overview_of(sealed(live)).read_bytes(), type=Overview)
    assert overview.joints == ("elbow",)
    assert overview.time_s == (0.0, 0.2, 0.4, 0.6, 0.8, 8.0, 8.2, 8.4, 8.6, 8.8)
    assert {len(column) for column in (overview.position_rad, overview.applied_rad, overview.mode)} == {10}
    assert overview.position_rad[0] == (0.123457,)
    assert overview.source[0] == "operator"


def overview_with(live: LiveSegment, events: list[Entry]) -> Overview:
    live.write(control_rows(0, 125), events)
    return msgspec.json.decode(overview_of(sealed(live)).read_bytes(), type=Overview)


def test_the_overview_has_the_events_in_order_of_time_with_short_texts(live: LiveSegment) -> None:
    late = event(100, kind="driver-failed", severity="error", message="x" * 500)
    overview = overview_with(live, [late, event(25), event(30, kind="activity", message="sums")])
    assert overview.events is not None
    first, second = overview.events
    assert first == OverviewEvent(time_s=0.2, kind="stop-latched", severity="info", text="stopped")
    assert (second.time_s, second.kind, second.severity) == (0.8, "driver-failed", "error")
    assert second.text == "x" * (MAX_EVENT_TEXT - 1) + "…"
    assert overview.events_omitted == 0


def test_the_overview_keeps_the_most_severe_of_many_events_and_counts_the_others(live: LiveSegment) -> None:
    many = [event(number % 125, kind="command-rejected") for number in range(MAX_OVERVIEW_EVENTS + 20)]
    overview = overview_with(live, [*many, event(120, severity="error", message="fault")])
    assert overview.events is not None
    assert (len(overview.events), overview.events_omitted) == (MAX_OVERVIEW_EVENTS, 21)
    assert [each.text for each in overview.events if each.severity == "error"] == ["fault"]
    assert [each.time_s for each in overview.events] == sorted(each.time_s for each in overview.events)


def test_an_overview_of_an_older_agent_has_unknown_events(live: LiveSegment) -> None:
    fields = msgspec.to_builtins(overview_with(live, []))
    assert not fields.pop("events")
    del fields["events_omitted"]
    assert msgspec.convert(fields, Overview, strict=False).events is None


def test_a_second_of_rows_is_a_chunk(live: LiveSegment) -> None:
    """A reader decodes one chunk to show one row."""
    values = dict.fromkeys(("position_rad", "requested_rad", "commanded_rad", "applied_rad"), (0.1,) * 6)
    live.write([control_row(number, velocity_rad_s=(0.0,) * 6, **values) for number in range(1000)], [])
    with sealed(live).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    lengths_s = [(each.message_end_time - each.message_start_time) / 1e9 for each in summary.chunk_indexes]
    assert 0.2 < max(lengths_s) < 4
