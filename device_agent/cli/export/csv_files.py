"""CSV: a folder with one file for control rows, one for measurements and one for events."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import msgspec

from device_agent.cli.export.recording import Row
from device_agent.cli.export.request import ExportFormat, ExportRequest
from device_agent.cli.export.segments import decode
from device_agent.protocol.events import Event
from device_agent.protocol.telemetry import Measurements
from device_agent.runtime.recording import format as recording_format

_VECTORS = (
    ("position_rad", "position", "rad or m"),
    ("velocity_rad_s", "velocity", "rad/s or m/s"),
    ("effort_nm", "effort", "Nm or N"),
    ("requested_rad", "requested", "rad or m"),
    ("commanded_rad", "commanded", "rad or m"),
    ("applied_rad", "applied", "rad or m"),
)
"""Field, name of its columns, unit. Revolute joints have the first unit, prismatic joints the second."""
_FIRST = ("time [s]", "wall_clock [ms]", "tick [ns]", "sequence", "after_gap", "mode", "source")
_LAST = (
    "twist.forward [m/s]", "twist.left [m/s]", "twist.turn [rad/s]", "setpoint_sequence", "seen_tick [ms]",
    "loop_age [ms]", "limited",
)  # fmt: skip
_measurements, _events = msgspec.json.Decoder(Measurements), msgspec.json.Decoder(Event)


def create() -> ExportFormat:
    """The format."""
    return write


def write(request: ExportRequest) -> str:
    """Write ``control.csv``, ``measurements.csv`` and ``events.csv``; returns the number of rows in words.

    Raises:
        ExportError: The recording cannot be read.
    """
    request.output.mkdir(parents=True)
    joints = request.recording.info.joints
    header = [*_FIRST, *(f"{joint}.{name} [{unit}]" for _, name, unit in _VECTORS for joint in joints), *_LAST]
    rows = (row for span_ns in request.spans_ns() for row in request.recording.rows(span_ns))
    lines = (_control(request, row) for row in request.progress.count(rows, "control rows"))
    count = _write(request, "control.csv", header, lines)
    _write(request, "measurements.csv", ("time [s]", "topic", "name and unit", "value"), _measured(request))
    _write(request, "events.csv", ("time [s]", "kind", "severity", "message"), _happened(request))
    return f"{count} control rows"


def _control(request: ExportRequest, row: Row) -> list[Any]:
    control, joints = row.control, len(request.recording.info.joints)
    values: list[Any] = [
        f"{request.recording.session_s(row.time_ns):.6f}", control.at_ms, control.tick_ns, control.sequence,
        int(row.after_gap), control.mode, control.source,
    ]  # fmt: skip
    for name, _, _ in _VECTORS:
        vector = getattr(control, name)
        values += vector if len(vector) == joints else [""] * joints  # some drivers measure no velocity or effort
    return [
        *values, *control.twist, control.setpoint_sequence, control.seen_tick_ms, control.loop_age_ms,
        " ".join(control.limited),
    ]  # fmt: skip


def _measured(request: ExportRequest) -> Iterator[Sequence[Any]]:
    prefixes = (recording_format.MEASUREMENTS, recording_format.ROOM)
    for span_ns in request.spans_ns():
        for entry in request.recording.entries(span_ns):
            if entry.topic.startswith(prefixes):
                for name, value in decode(_measurements, entry).values.items():
                    yield f"{request.recording.session_s(entry.time_ns):.6f}", entry.topic, name, float(value)


def _happened(request: ExportRequest) -> Iterator[Sequence[Any]]:
    for span_ns in request.spans_ns():
        for entry in request.recording.entries(span_ns, (recording_format.EVENTS,)):
            event = decode(_events, entry)
            time_s = f"{request.recording.session_s(entry.time_ns):.6f}"
            yield time_s, event.kind, event.severity, event.message


def _write(request: ExportRequest, name: str, header: Sequence[str], lines: Iterable[Sequence[Any]]) -> int:
    count = 0
    with ExitStack() as stack:
        file = stack.enter_context((request.output / name).open("w", newline="", encoding="utf-8"))
        writer = csv.writer(file)
        writer.writerow(header)
        for line in lines:
            writer.writerow(line)
            count += 1
    return count
