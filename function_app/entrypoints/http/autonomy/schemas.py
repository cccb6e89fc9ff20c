"""Responses about sessions and autonomy."""

from typing import Annotated, Literal

from msgspec import Meta

from function_app.entrypoints.http.framework.schemas import Moment, Request, Response

Seconds = Annotated[float, Meta(ge=0, le=1e7)]


class MotionShareOut(Response, frozen=True, kw_only=True):
    """Moving time by its source, and the metrics GTI = HTI + MTI = 1 and MTIA = MTI / HTI.

    ``operator_s``: time in which setpoints of an operator moved the device [s]. ``machine_s``: all other moving time
    [s]. ``hti`` and ``mti`` are null without motion. ``mtia`` is null if no operator moved the device: it is undefined.
    """

    operator_s: float
    machine_s: float
    hti: float | None
    mti: float | None
    mtia: float | None


class DeviceSessionOut(Response, frozen=True, kw_only=True):
    """A session: the time in which one account or action holds the lease.

    ``action``, ``task``, ``outcome``: the action that has the lease, its movement or kind, and its status; null if a
    person has it. ``intervened``: a person ended the action before its end. ``start``, ``end``: kind of the event that
    started or ended it. ``ended_at``: null while it lasts. ``first_input_s``: time from the grant to the
    operator's first motion [s]. ``recorded``: whether a recording is stored.
    """

    epoch: int
    holder: str | None
    action: str | None
    task: str | None
    outcome: str | None
    intervened: bool
    started_at: Moment | None
    ended_at: Moment | None
    start: str | None
    end: str | None
    first_input_s: float | None
    share: MotionShareOut
    recorded: bool


class SegmentOut(Response, frozen=True, kw_only=True):
    """A segment of a recording. The URLs of the MCAP file and of its overview are valid for one hour."""

    segment: int
    started_at: Moment
    ended_at: Moment
    length: int
    sha256: str
    url: str
    overview_url: str


class Episode(Request, frozen=True, kw_only=True):
    """A part of a session that shows one attempt at a task. Times are relative to the start of the session [s]."""

    start_s: Seconds
    end_s: Seconds
    outcome: Literal["success", "failure"] | None = None
    label: Annotated[str, Meta(max_length=200)] = ""
    note: Annotated[str, Meta(max_length=2000)] = ""


class MissingSegment(Response, frozen=True, kw_only=True):
    """A segment that is not stored: the agent will upload it, has lost it, or does not state what it has."""

    segment: int
    cause: Literal["waiting", "lost", "unknown"]


class RecordingOut(Response, frozen=True, kw_only=True):
    """The recording of a session. ``complete``: the session has ended, and the segments cover it without a gap.

    ``final``: nothing new can arrive, also if segments are missing.
    """

    segments: tuple[SegmentOut, ...]
    cameras: tuple[str, ...]
    episodes: tuple[Episode, ...]
    complete: bool
    missing: tuple[MissingSegment, ...]
    final: bool


class SessionWithRecording(DeviceSessionOut, frozen=True, kw_only=True):
    """A session with its recording; null: none is stored. The ETag of the response is that of its episodes."""

    recording: RecordingOut | None


class EpisodesRequest(Request, frozen=True, kw_only=True):
    """All episodes of a recording."""

    episodes: Annotated[tuple[Episode, ...], Meta(max_length=500)]


class EpisodeList(Response, frozen=True, kw_only=True):
    """All episodes of a recording, in the order of time."""

    episodes: tuple[Episode, ...]


class DeviceSessionList(Response, frozen=True, kw_only=True):
    """Sessions, newest first."""

    items: tuple[DeviceSessionOut, ...]
    cursor: str | None


class DayOut(Response, frozen=True, kw_only=True):
    """Sums of the sessions that started on one day. ``at``: its first moment in UTC."""

    at: Moment
    share: MotionShareOut


class TaskOut(Response, frozen=True, kw_only=True):
    """Sums of one movement or kind of action."""

    name: str
    share: MotionShareOut


class AutonomyOut(Response, frozen=True, kw_only=True):
    """Autonomy of a device in a time span.

    ``sessions``: number of sessions. ``actions``: number of those that belong to an action. Actions that a person
    starts while in control belong to the person's session. ``interventions``: number of these actions that a person
    ended before their end. ``takeover_s``: median time from a grant to the first motion by its operator [s].
    ``workload``: share of the operators' lease time in which they moved the device. ``complete``: false if the oldest
    sessions are missing, because there are too many.
    """

    share: MotionShareOut
    sessions: int
    actions: int
    interventions: int
    takeover_s: float | None
    workload: float | None
    days: tuple[DayOut, ...]
    tasks: tuple[TaskOut, ...]
    complete: bool
