"""A recorded session of an arm in memory, and the calls of the HTTP API that serve it to a page.

The session contains a gap, a missing segment, commands of an operator and of a movement, a stop, and images.
"""

import base64
import functools
import hashlib
import io
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import msgspec
from mcap.writer import Writer
from playwright.sync_api import BrowserContext, Route

from device_agent.protocol.events import Event
from device_agent.protocol.state import Mode
from device_agent.runtime.recording.format import (
    CHUNK_BYTES,
    CONTROL,
    EVENTS,
    FRAMES,
    METADATA,
    OVERVIEW_S,
    PROFILE,
    SEGMENT_S,
    ControlRow,
    Overview,
    OverviewEvent,
    SegmentInfo,
    Source,
)
from tests.harness.network.cameras.pictures import jpeg

EPOCH: Final = 7
JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
PERIOD_MS: Final = 8
STARTED_MS: Final = 1_790_000_000_000
STARTED_TICK_NS: Final = 5_000_000_000_000
CAMERA: Final = f"{FRAMES}front"
IMAGE_EVERY_MS: Final = 200
MISSING_SEGMENT: Final = 33
GAP_MS: Final = range(20 * 60_000 + 10_000, 20 * 60_000 + 25_000)
"""Times without rows [ms]."""
STOP_MS: Final = range(50 * 60_000, 50 * 60_000 + 40_000)
"""Times in which Stop is latched [ms]."""
_LOOP_AGE_MS: Final = 84
_CYCLE_S: Final = 90
_OPERATOR_S: Final = 50
_MOVEMENT_S: Final = 75
_LAG_MS: Final = 12 * PERIOD_MS


FILES: Final = "/api/v1/recorded"
"""Folder of the files on the server."""


@dataclass
class RecordedSession:
    """``files``: name → content. ``recording``: the field of the API. ``version``: the ETag, without quotes."""

    files: dict[str, bytes]
    recording: dict[str, Any] | None
    minutes: int
    epoch: int = EPOCH
    version: int = 1

    def serve(self, context: BrowserContext, device: str, *others: "RecordedSession") -> None:
        """Answers the calls of a page for this session and others; all other calls reach the product."""
        path = f"**/api/v1/devices/{device}/sessions"
        sessions = (self, *others)
        context.route(
            f"{path}?*", lambda route: _answer(route, {"items": [each._item() for each in sessions], "cursor": None})
        )
        for each in sessions:
            context.route(f"{path}/{each.epoch}", each._describe)
            context.route(f"{path}/{each.epoch}/episodes", each._save_episodes)
            context.route(f"{path}/{each.epoch}/recording", each._remove)
            context.route(f"**{FILES}/{each.epoch}-*", each._send_file)

    def _item(self) -> dict[str, Any]:
        return {
            "epoch": self.epoch,
            "holder": "demo",
            "action": None,
            "task": None,
            "outcome": None,
            "intervened": False,
            "started_at": _time(0),
            "ended_at": _time(self.minutes * 60_000),
            "share": {"operator_s": 1000.0, "machine_s": 500.0, "hti": 2 / 3, "mti": 1 / 3, "mtia": 0.5},
            "recorded": self.recording is not None,
        }

    def _describe(self, route: Route) -> None:
        _answer(route, self._item() | {"recording": self.recording}, version=self.version)

    def _save_episodes(self, route: Route) -> None:
        if route.request.headers["if-match"] != f'"{self.version}"' or self.recording is None:
            _answer(route, {"type": "/problems/changed", "detail": "The episodes have changed."}, status=412)
            return
        self.recording["episodes"] = msgspec.json.decode(route.request.post_data or "{}")["episodes"]
        self.version += 1
        _answer(route, {"episodes": self.recording["episodes"]}, version=self.version)

    def _remove(self, route: Route) -> None:
        self.recording = None
        route.fulfill(status=204)

    def _send_file(self, route: Route) -> None:
        content = self.files.get(route.request.url.rpartition("/")[2])
        route.fulfill(status=404) if content is None else route.fulfill(status=200, body=content)


def _answer(route: Route, body: object, *, status: int = 200, version: int | None = None) -> None:
    headers = {"Content-Type": "application/json"} | ({} if version is None else {"ETag": f'"{version}"'})
    route.fulfill(status=status, headers=headers, body=msgspec.json.encode(body))


def record_session(minutes: int, *, epoch: int = EPOCH, delay_ms: int = 0) -> RecordedSession:
    """A session of a number of minutes. ``delay_ms``: how much later its motion begins than in another session."""
    files: dict[str, bytes] = {}
    segments = []
    for number in range(minutes):
        if number == MISSING_SEGMENT:
            continue
        started_ms, ended_ms = (round((number + more) * SEGMENT_S * 1000) for more in (0, 1))
        times = (ms for ms in range(started_ms, ended_ms, PERIOD_MS) if ms not in GAP_MS)
        rows = [_row(ms, epoch, delay_ms) for ms in times]
        content = _segment(number, epoch, rows, range(started_ms, ended_ms, IMAGE_EVERY_MS))
        files[f"{epoch}-{number}.mcap"] = content
        files[f"{epoch}-{number}.json"] = _overview(number, rows)
        segments.append(
            {
                "segment": number,
                "started_at": _time(started_ms),
                "ended_at": _time(ended_ms),
                "length": len(content),
                "sha256": hashlib.sha256(content).hexdigest(),
                "url": f"{FILES}/{epoch}-{number}.mcap",
                "overview_url": f"{FILES}/{epoch}-{number}.json",
            }
        )
    episodes = [
        {"start_s": 20.0, "end_s": 300.0, "outcome": "success", "label": "Pick", "note": "The cup was upright."},
        {"start_s": 300.0, "end_s": 580.0, "outcome": "failure", "label": "Place", "note": ""},
    ]
    missing = [{"segment": MISSING_SEGMENT, "cause": "lost"}] if minutes > MISSING_SEGMENT else []
    recording: dict[str, Any] = {
        "segments": segments,
        "cameras": [CAMERA],
        "episodes": episodes,
        "complete": not missing,
        "missing": missing,
        "final": True,
    }
    return RecordedSession(files, recording, minutes, epoch)


def _time(ms: int) -> str:
    return datetime.fromtimestamp((STARTED_MS + ms) / 1000, UTC).isoformat().replace("+00:00", "Z")


def _source(ms: int) -> Source:
    in_cycle_s = ms / 1000 % _CYCLE_S
    if ms in STOP_MS:
        return Source.STOP
    if in_cycle_s < _OPERATOR_S:
        return Source.OPERATOR
    return Source.MOVEMENT if in_cycle_s < _MOVEMENT_S else Source.HOLD


_MODES: Final[dict[Source, Mode]] = {
    Source.OPERATOR: Mode.STREAMING,
    Source.MOVEMENT: Mode.ACTION,
    Source.HOLD: Mode.HOLDING,
    Source.STOP: Mode.STOPPED,
}


@functools.lru_cache(maxsize=64)
def _positions(ms: int) -> tuple[float, ...]:
    at_s = ms / 1000
    start = (0.3, -1.4, 1.5, -1.6, -1.5, 0.0)
    return tuple(
        round(base + 0.4 * math.sin(at_s / (2.0 + joint) + joint) + 0.05 * math.sin(at_s * 2.1 + joint), 6)
        for joint, base in enumerate(start)
    )


def _row(ms: int, epoch: int, delay_ms: int) -> ControlRow:
    source = _source(ms)
    operated = source is Source.OPERATOR
    moved_ms = ms - delay_ms
    target, command = _positions(moved_ms + _LAG_MS), _positions(moved_ms + _LAG_MS // 2)
    return ControlRow(
        tick_ns=STARTED_TICK_NS + ms * 1_000_000,
        at_ms=STARTED_MS + ms,
        sequence=ms // PERIOD_MS,
        epoch=epoch,
        mode=_MODES[source],
        source=source,
        position_rad=_positions(moved_ms),
        velocity_rad_s=(0.0,) * len(JOINTS),
        effort_nm=(0.0,) * len(JOINTS),
        requested_rad=target,
        commanded_rad=command,
        applied_rad=command,
        setpoint_sequence=ms // 32 if operated else 0,
        seen_tick_ms=STARTED_TICK_NS // 1_000_000 + ms - _LOOP_AGE_MS if operated and ms > _LOOP_AGE_MS else 0,
        loop_age_ms=float(_LOOP_AGE_MS) if operated else 0.0,
        limited=("latency",) if operated and ms // 1000 % 7 == 0 else (),
    )


def _segment(number: int, epoch: int, rows: list[ControlRow], image_times: range) -> bytes:
    info = SegmentInfo(
        device="ur5",
        robot_type="ur5",
        robot_type_version=1,
        epoch=epoch,
        segment=number,
        holder="demo",
        joints=JOINTS,
        period_ms=PERIOD_MS,
        cameras=(CAMERA,),
        started_ns=STARTED_MS * 1_000_000,
        started_tick_ns=STARTED_TICK_NS,
        simulated=True,
        software="benchmark",
    )
    output = io.BytesIO()
    writer = Writer(output, chunk_size=CHUNK_BYTES)
    writer.start(profile=PROFILE)
    fields = msgspec.to_builtins(info)
    writer.add_metadata(METADATA, {name: msgspec.json.encode(value).decode() for name, value in fields.items()})
    schema = writer.register_schema("Row", "jsonschema", b"{}")
    channels = {topic: writer.register_channel(topic, "json", schema) for topic in (CONTROL, EVENTS, CAMERA)}

    def write(topic: str, ms: int, message: object) -> None:
        log_ns = (STARTED_MS + ms) * 1_000_000
        writer.add_message(channels[topic], log_ns, msgspec.json.encode(message), log_ns)

    events = iter([*_events(number), None])
    event = next(events)
    for row in rows:
        ms = row.at_ms - STARTED_MS
        write(CONTROL, ms, row)
        while event is not None and event.at_ms <= row.at_ms:
            write(EVENTS, event.at_ms - STARTED_MS, event)
            event = next(events)
        if ms % IMAGE_EVERY_MS == 0 and ms in image_times:
            image = {"format": "jpeg", "data": base64.b64encode(jpeg(ms // IMAGE_EVERY_MS)).decode()}
            write(CAMERA, ms, image)
    writer.finish()
    return output.getvalue()


def _events(number: int) -> list[Event]:
    """Events of one minute: a late input in each, and the commands of the session in their minutes."""
    found = [(5_000, "motion-held", "warning", "The operator's input is late: the arm holds its position.")]
    if number == 0:
        found.insert(0, (1_000, "lease-granted", "info", "demo has control"))
    if number * 60 % _CYCLE_S == 0:
        found.append((_OPERATOR_S * 1_000, "action-started", "info", "action run_movement wave of demo started"))
    if number % 10 == 2:
        found.append((30_000, "driver-failed", "error", "The robot's controller does not respond."))
    if number == STOP_MS.start // 60_000:
        found.insert(0, (0, "stop-latched", "warning", "demo pressed Stop"))
    return [
        Event(
            id=f"event{number}-{index}",
            device="ur5",
            at_ms=STARTED_MS + number * 60_000 + ms,
            kind=kind,
            severity=severity,  # type: ignore[arg-type]
            message=message,
        )
        for index, (ms, kind, severity, message) in enumerate(found)
    ]


def _overview(number: int, rows: list[ControlRow]) -> bytes:
    every = round(OVERVIEW_S * 1000) // PERIOD_MS
    chosen = rows[::every]
    overview = Overview(
        joints=JOINTS,
        time_s=tuple((row.at_ms - STARTED_MS) / 1000 for row in chosen),
        position_rad=tuple(row.position_rad for row in chosen),
        applied_rad=tuple(row.applied_rad for row in chosen),
        source=tuple(row.source for row in chosen),
        mode=tuple(row.mode for row in chosen),
        events=tuple(
            OverviewEvent(
                time_s=(each.at_ms - STARTED_MS) / 1000, kind=each.kind, severity=each.severity, text=each.message
            )
            for each in _events(number)
        ),
    )
    return msgspec.json.encode(overview)
