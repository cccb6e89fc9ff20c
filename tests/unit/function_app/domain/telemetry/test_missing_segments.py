"""The list of missing segments is bounded, also if a number is far above the others."""

from dataclasses import replace

from function_app.domain.telemetry.recordings import MAX_MISSING, Missing, Segment, is_final, missing_segments
from function_app.domain.telemetry.sessions import Session

FIRST = Segment(
    epoch=1,
    segment=0,
    started_ms=0,
    ended_ms=60_000,
    length=1,
    sha256="",
    overview_length=1,
    overview_sha256="",
    pending=(),
    stored_ms=1,
)
ENDED = Session(epoch=1, holder="anna", started_ms=1, ended_ms=10**8)


def test_a_long_gap_is_listed_in_part() -> None:
    last = replace(FIRST, segment=999_999, pending=(), stored_ms=10**9)
    assert missing_segments([FIRST, last]) == tuple(Missing(each, "lost") for each in range(1, MAX_MISSING + 1))
    assert is_final(ENDED, [FIRST, last])


def test_a_recording_is_not_final_while_a_segment_waits_that_is_not_listed() -> None:
    last = replace(FIRST, segment=3_000, pending=(2_999,), stored_ms=10**9)
    assert {each.cause for each in missing_segments([FIRST, last])} == {"lost"}
    assert not is_final(ENDED, [FIRST, last])
    stored = replace(FIRST, segment=2_999, stored_ms=10**9 - 1)
    assert is_final(ENDED, [FIRST, stored, last])
