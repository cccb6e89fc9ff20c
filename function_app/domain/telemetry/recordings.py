"""Recordings of sessions: their segments and episodes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Final, Literal

from function_app.domain.common.problems import invalid
from function_app.domain.telemetry.sessions import Session

TOLERANCE_S: Final = 10.0
"""A recording continues until the robot rests, and agents learn of the end of a session later than the cloud [s]."""

MIN_SEGMENT_S: Final = 1.0
"""Agents begin a segment each minute, and earlier if it is large or the disk was full, but not more often [s]."""
SPARE_SEGMENTS: Final = 1_000
"""Further numbers that are accepted, because clocks differ and restarts of an agent begin segments."""
MAX_MISSING: Final = 1_000
"""Most missing segments that are listed: a gap may be much longer than the list of stored segments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """One announced or stored segment of a recording.

    Attributes:
        epoch: Epoch of the session.
        segment: Number in the session, from 0.
        started_ms: First message, on the agent's clock [ms since 1970].
        ended_ms: Last message [ms since 1970].
        length: Size of the MCAP file [bytes].
        sha256: Its hash (hex).
        overview_length: Size of the overview [bytes].
        overview_sha256: Its hash (hex).
        cameras: Topics of recorded cameras.
        rows: Number of control periods.
        blob: Name of the MCAP file's blob.
        overview_blob: Name of the overview's blob.
        account: Owner of the device at the upload, whose storage it uses.
        state: Whether both files are stored.
        expires_ms: Time of deletion [ms since 1970].
        pending: Other segments of the session that the agent had when this one was stored; ``None``: not named.
        stored_ms: When it was stored [ms since 1970].
    """

    epoch: int
    segment: int
    started_ms: int
    ended_ms: int
    length: int
    sha256: str
    overview_length: int
    overview_sha256: str
    cameras: tuple[str, ...] = ()
    rows: int = 0
    blob: str = ""
    overview_blob: str = ""
    account: str = ""
    state: Literal["waiting", "stored"] = "waiting"
    expires_ms: int = 0
    pending: tuple[int, ...] | None = None
    stored_ms: int = 0

    @property
    def content(self) -> tuple[str, int, str]:
        """Hash, size and hash of the overview: what makes two segments equal."""
        return self.sha256, self.length, self.overview_sha256


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """A part of a session that shows one attempt at a task.

    Attributes:
        start_s: Its start, relative to the start of the session [s].
        end_s: Its end [s].
        outcome: Result of the attempt; ``None``: not judged.
        label: The task.
        note: Remark.
    """

    start_s: float
    end_s: float
    outcome: Literal["success", "failure"] | None = None
    label: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingRow:
    """What is stored once for each recording.

    Attributes:
        epoch: Epoch of the session.
        recorded: Whether a segment is stored.
        deleted: Whether the owner deleted the recording: later segments are discarded.
        version: Version of the list of episodes.
        episodes: The episodes in the order of time.
        expires_ms: Time of deletion [ms since 1970].
    """

    epoch: int
    recorded: bool = False
    deleted: bool = False
    version: int = 0
    episodes: tuple[Episode, ...] = ()
    expires_ms: int = 0


def check_episodes(episodes: Sequence[Episode], *, duration_s: float) -> tuple[Episode, ...]:
    """The episodes in the order of time.

    Raises:
        Problem: ``episodes-invalid``: one is outside the session, ends before it starts, or overlaps another.
    """
    ordered = tuple(sorted(episodes, key=lambda each: each.start_s))
    for each in ordered:
        where = f"The episode from {each.start_s:g} s to {each.end_s:g} s"
        if not each.start_s < each.end_s:
            raise invalid(f"{where} must end after its start.", code="episodes-invalid")
        if each.start_s < 0 or each.end_s > duration_s:
            detail = f"{where} is outside the session, which lasts {duration_s:.1f} s."
            raise invalid(detail, code="episodes-invalid")
    for one, other in pairwise(ordered):
        if one.end_s > other.start_s:
            detail = f"The episodes that start at {one.start_s:g} s and {other.start_s:g} s overlap. Trim one of them."
            raise invalid(detail, code="episodes-invalid")
    return ordered


def duration_s(session: Session, segments: Sequence[Segment], *, now_ms: int) -> float:
    """How long a session has lasted until now, by the cloud's clock or by its recording [s]."""
    lasted_ms = (session.ended_ms or now_ms) - session.started_ms if session.started_ms else 0
    return max(lasted_ms, _recorded_ms(segments)) / 1000


def check_numbers(session: Session, numbers: Iterable[int], *, now_ms: int) -> None:
    """Refuse numbers of segments that the session cannot have reached.

    Raises:
        Problem: ``invalid``.
    """
    lasted_s = max(0, now_ms - session.started_ms) / 1000
    last = int(lasted_s / MIN_SEGMENT_S) + SPARE_SEGMENTS
    number = max(numbers, default=0)
    if number > last:
        began = f"Session {session.epoch} began {lasted_s:.0f} s ago"
        raise invalid(f"{began} and cannot have segment {number}. Send a number up to {last}.")


def is_complete(session: Session, segments: Sequence[Segment]) -> bool:
    """Whether a session has ended and its stored segments cover it without a gap."""
    if not session.ended_ms or [each.segment for each in segments] != list(range(len(segments))):
        return False
    lasted_ms = session.ended_ms - session.started_ms
    return bool(segments) and _recorded_ms(segments) >= lasted_ms - TOLERANCE_S * 1000


@dataclass(frozen=True, slots=True)
class Missing:
    """A segment that is not stored.

    Attributes:
        segment: Its number in the session.
        cause: ``waiting``: the agent will upload it. ``lost``: the agent does not have it any more.
            ``unknown``: the agent is older and does not name the segments that it has.
    """

    segment: int
    cause: Literal["waiting", "lost", "unknown"]


def missing_segments(segments: Sequence[Segment]) -> tuple[Missing, ...]:
    """The first ``MAX_MISSING`` segments that are not stored although a later one is, or the agent will upload them."""
    pending = _pending(segments)
    stored = {each.segment for each in segments}
    waiting = set(pending or ()) - stored
    numbers = range(max(stored | waiting, default=-1) + 1)
    absent = islice((number for number in numbers if number not in stored), MAX_MISSING)

    def cause(number: int) -> Literal["waiting", "lost", "unknown"]:
        return "waiting" if number in waiting else "unknown" if pending is None else "lost"

    return tuple(Missing(number, cause(number)) for number in absent)


def is_final(session: Session, segments: Sequence[Segment]) -> bool:
    """Whether nothing new can arrive: the recording is complete, or the agent has no other segment of the session."""
    if is_complete(session, segments):
        return True
    stored_ms = max((each.stored_ms for each in segments), default=0)
    pending = _pending(segments)
    uploaded = pending is not None and {each.segment for each in segments}.issuperset(pending)
    return uploaded and 0 < session.ended_ms <= stored_ms


def _pending(segments: Sequence[Segment]) -> tuple[int, ...] | None:
    """The segments that the agent had when the newest one was stored; ``None``: it has not named them."""
    newest = max(segments, key=lambda each: (each.stored_ms, each.segment), default=None)
    return None if newest is None else newest.pending


def _recorded_ms(segments: Sequence[Segment]) -> int:
    """Time from the first to the last message, on the agent's clock alone [ms]."""
    if not segments:
        return 0
    return max(each.ended_ms for each in segments) - min(each.started_ms for each in segments)
