"""The recording of one device: which control periods and messages are recorded, and whether that works.

The control loop only appends to a bounded queue. If it is full, rows are dropped, which shows as a gap in ``sequence``.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec

from device_agent.config import release
from device_agent.ports.clock import wall_ms
from device_agent.protocol import Event, Fault, Measurements, Mode
from device_agent.protocol.events import EventKind
from device_agent.protocol.manifests.robot_type import RobotType
from device_agent.runtime.authority.event_recorder import EventRecord, RecordEvent
from device_agent.runtime.control.control_loop import Period
from device_agent.runtime.recording.format import EVENTS, MEASUREMENTS, ROOM, ControlRow, SegmentInfo, Source
from device_agent.runtime.recording.messages import Batch, Entry, RecordedFrame, RecorderStatus

AFTER_S = 5.0
"""Time for which a robot that still moves is recorded after the end of the lease [s]."""
PAUSE_S = 1.0
"""Time for which the session of an action without a lease continues after it [s]: a trial reserves the robot again
after its script, and one action must not have two sessions."""
MAX_QUEUED = 4096
"""Rows and other messages of one device that wait for the recorder process: half a minute at 125 Hz."""
MAX_FRAMES = 16
"""Frames of cameras that wait for the recorder process, at most 2 MB; further ones are dropped."""
_BATCH = 64
_MAX_BEFORE = 8
_BEFORE_NS = 1_000_000_000
"""Events of this time before a session belong to it [ns]."""
_STALE_S = 2.0
"""A recording without a confirmed row for this time is not shown as active [s]."""
_SILENT_S = 10.0
"""Without a response for this time, the recording has failed [s]; the start of the process takes a part of it."""
_SOURCES = {Mode.STREAMING: Source.OPERATOR, Mode.ACTION: Source.MOVEMENT, Mode.STOPPED: Source.STOP}


@dataclass(frozen=True, slots=True)
class _Session:
    """A session: its epoch, and its start on both clocks [ns]."""

    epoch: int
    started_ns: int
    started_tick_ns: int


@dataclass(frozen=True, slots=True)
class _Row:
    """A control period, with the wall clock [ms] and its number in the session."""

    period: Period
    at_ms: int
    sequence: int
    epoch: int


@dataclass(frozen=True, slots=True)
class _Message:
    """Another message of the session, with the monotonic [ns] and the wall clock [ms]."""

    topic: str
    content: Event | Measurements
    tick_ns: int
    at_ms: int


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame of a camera, and whether it may still be recorded when it is taken from the queue."""

    frame: RecordedFrame
    is_permitted: Callable[[], bool]


class _End:
    """The end of the session."""


class DeviceRecording:
    """The recording of one device. ``record_period`` is called by its control loop, ``take`` by the recorder.

    Args:
        agent: Id of the agent.
        name: Name of the device.
        robot_type: Its robot type.
        simulated: Whether it is simulated.
        newest_epoch: The highest epoch that the device has seen: that of a running action.
        holder: Name of the operator with a lease, or of the account that started the running action, by epoch.
        record: Records events.
    """

    def __init__(
        self,
        agent: str,
        name: str,
        robot_type: RobotType,
        *,
        simulated: bool,
        newest_epoch: Callable[[], int],
        holder: Callable[[int], str],
        record: RecordEvent,
    ) -> None:
        self._id = f"{agent}-{name}"
        self._name = name
        self._robot_type = robot_type
        self._simulated = simulated
        self._newest_epoch = newest_epoch
        self._holder = holder
        self._record = record
        self._queue: deque[_Session | _Row | _Message | _Frame | _End] = deque()
        self._free_frames = threading.Semaphore(MAX_FRAMES)
        # The event of a grant may arrive before the control period that begins the session.
        self._before: deque[_Message] = deque(maxlen=_MAX_BEFORE)
        # Of the control loop.
        self._session: _Session | None = None
        self._sequence = 0
        self._until_s = self._paused_until_s = 0.0
        # Of the recorder's thread.
        self._taken: SegmentInfo | None = None
        self._failed = False
        self._error = ""
        self._confirmed_s, self._expected_s = float("-inf"), float("inf")

    # ------------------------------------------------------------ control loop

    def record_period(self, period: Period) -> None:
        """Record a control period if a lease or an action is in force, or has just ended and the robot still moves."""
        output = period.output
        epoch = output.epoch or (self._newest_epoch() if output.mode is Mode.ACTION else 0)
        if epoch:
            self._until_s = period.now_s + AFTER_S
            self._paused_until_s = period.now_s + (0.0 if output.epoch else PAUSE_S)
            if self._session is None or self._session.epoch != epoch:
                self._begin(epoch, period.now_s)
        session = self._session
        if session is None:
            return
        rested = not period.moving and period.now_s >= self._paused_until_s
        if not epoch and (rested or period.now_s >= self._until_s):
            self.end()
            return
        if len(self._queue) < MAX_QUEUED:
            self._queue.append(_Row(period, wall_ms(), self._sequence, session.epoch))
        self._sequence += 1

    def _begin(self, epoch: int, now_s: float) -> None:
        self.end()
        self._session = session = _Session(epoch, time.time_ns(), round(now_s * 1e9))
        self._sequence = 0
        self._queue.append(session)
        while self._before:
            message = self._before.popleft()
            if session.started_tick_ns - message.tick_ns < _BEFORE_NS:
                self._queue.append(replace(message, tick_ns=max(message.tick_ns, session.started_tick_ns)))

    def end(self) -> None:
        """End the session, if there is one."""
        if self._session is not None:
            self._session = None
            self._queue.append(_End())

    # ------------------------------------------------------------ any thread

    def add_event(self, event: Event) -> None:
        """Record an event of the device."""
        if self._session is None:
            self._before.append(_Message(EVENTS, event, time.monotonic_ns(), event.at_ms))
        else:
            self._add(EVENTS, event, event.at_ms)

    def add_measurements(self, stream: str, measured: Measurements) -> None:
        """Record measurements of the device."""
        self._add(f"{MEASUREMENTS}{stream}", measured, measured.at_ms)

    def add_reading(self, device: str, stream: str, measured: Measurements) -> None:
        """Record measurements of a room device, by its id."""
        if device != self._id:
            self._add(f"{ROOM}{device}/{stream}", measured, measured.at_ms)

    def _add(self, topic: str, content: Event | Measurements, at_ms: int) -> None:
        if self._session is not None and len(self._queue) < MAX_QUEUED:
            self._queue.append(_Message(topic, content, time.monotonic_ns(), at_ms))

    def add_frame(self, frame: RecordedFrame, is_permitted: Callable[[], bool]) -> None:
        """Record a frame of a camera that was taken in the present session; it is dropped if too many wait."""
        session = self._session
        if (
            session is not None
            and frame.tick_ns >= session.started_tick_ns
            and self._free_frames.acquire(blocking=False)
        ):
            self._queue.append(_Frame(frame, is_permitted))

    @property
    def in_session(self) -> bool:
        """Whether there is a session."""
        return self._session is not None

    @property
    def active(self) -> bool:
        """Whether the present session is being recorded, as the recorder process has just confirmed."""
        confirmed = time.monotonic() - self._confirmed_s < _STALE_S
        return self._session is not None and not self._failed and confirmed

    def faults(self) -> tuple[Fault, ...]:
        """Why the present session is not recorded, if it is not."""
        if self._session is None:
            return ()
        error = self._error
        if not error and self._queue and time.monotonic() - self._expected_s > _SILENT_S:
            error = "the session is not recorded: the recorder process does not respond"
        return (Fault(code="recording", message=error[:2000], since_ms=wall_ms()),) if error else ()

    # ------------------------------------------------------------ the recorder's thread

    def take(self) -> Iterator[Batch]:
        """Batches with what was recorded since the last call. Each must be sent before the next one is taken."""
        if not self._queue:
            self._expected_s = time.monotonic()
        while self._queue:
            rows: list[ControlRow] = []
            entries: list[Entry] = []
            frames: list[RecordedFrame] = []
            ended = False
            while self._queue and len(rows) + len(entries) + len(frames) < _BATCH and not ended:
                match self._queue.popleft():
                    case _Session() as session:
                        self._taken, self._failed, self._error = self._info(session), False, ""
                        self._confirmed_s = float("-inf")
                    case _Row() as row:
                        rows.append(_control_row(row))
                    case _Message(topic=topic, content=content, tick_ns=tick_ns, at_ms=at_ms):
                        data = msgspec.json.encode(content)
                        entries.append(Entry(topic, type(content).__name__, tick_ns, at_ms, data))
                    case _Frame(frame=frame, is_permitted=is_permitted):
                        self._free_frames.release()
                        # One of an ended session may be late, and consent may have been withdrawn meanwhile.
                        if self._taken and frame.tick_ns >= self._taken.started_tick_ns and is_permitted():
                            frames.append(frame)
                    case _:
                        ended = True
            yield Batch(
                session=self._taken, rows=tuple(rows), entries=tuple(entries), frames=tuple(frames), ended=ended
            )
            if ended:
                self._taken = None

    def confirm(self, status: RecorderStatus) -> None:
        """Handle the response to a batch."""
        now_s = time.monotonic()
        self._expected_s = now_s
        self._taken = self._taken and msgspec.structs.replace(self._taken, segment=status.segment)
        if status.error:
            self.fail(status.error)
            return
        self._confirmed_s = now_s
        if self._failed and self._taken is not None:
            self._failed, self._error = False, ""
            message = "the session is recorded again"
            self._record(EventRecord(EventKind.RECORDING_RESUMED, message, data={"epoch": self._taken.epoch}))

    def fail(self, error: str) -> None:
        """Report once that the session is not recorded."""
        if self._taken is None:
            return
        self._error = error
        if not self._failed:
            self._failed = True
            data = {"epoch": self._taken.epoch}
            self._record(EventRecord(EventKind.RECORDING_FAILED, error[:2000], "error", data))

    def drop(self, error: str) -> None:
        """Discard what was recorded since the last call, because of an error."""
        for _ in self.take():
            self.fail(error)

    def report_deleted(self, segments: int) -> None:
        """Report that segments were deleted before their upload."""
        message = f"{segments} recorded minutes were deleted before their upload: too old, or beyond the maximum size"
        self._record(EventRecord(EventKind.RECORDINGS_DELETED, message, "warning", {"segments": segments}))

    def _info(self, session: _Session) -> SegmentInfo:
        kind = self._robot_type
        return SegmentInfo(
            device=self._name,
            robot_type=kind.type,
            robot_type_version=kind.version,
            epoch=session.epoch,
            segment=0,
            holder=self._holder(session.epoch),
            joints=tuple(joint.name for joint in kind.joints),
            period_ms=kind.period_ms,
            cameras=(),
            started_ns=session.started_ns,
            started_tick_ns=session.started_tick_ns,
            simulated=self._simulated,
            software=release.VERSION,
        )


def _control_row(row: _Row) -> ControlRow:
    observation, output = row.period.observation, row.period.output
    source = _SOURCES.get(output.mode, Source.HOLD)
    streamed = source is Source.OPERATOR
    commanded = tuple(output.position_rad)
    return ControlRow(
        tick_ns=round(row.period.now_s * 1e9),
        at_ms=row.at_ms,
        sequence=row.sequence,
        epoch=row.epoch,
        mode=output.mode,
        source=source,
        position_rad=observation.position_rad,
        velocity_rad_s=observation.velocity_rad_s,
        effort_nm=observation.effort_nm,
        requested_rad=_positions(output.requested_rad, commanded),
        commanded_rad=commanded,
        applied_rad=tuple(row.period.applied_rad),
        twist=(output.twist.forward_m_s, output.twist.left_m_s, output.twist.turn_rad_s),
        setpoint_sequence=output.setpoint_sequence if streamed else 0,
        seen_tick_ms=output.seen_tick_ms if streamed else 0,
        loop_age_ms=output.loop_age_ms if streamed else 0.0,
        limited=output.limited,
    )


def _positions(requested: Sequence[float], commanded: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(requested) or commanded
