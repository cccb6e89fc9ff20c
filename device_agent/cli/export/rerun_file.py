"""Rerun: one file with joint values, camera images and events on the time of the session."""

from array import array
from typing import Final

import msgspec
import numpy as np
import rerun

from device_agent.cli.export.lerobot.images import read_image
from device_agent.cli.export.request import ExportFormat, ExportRequest
from device_agent.cli.export.segments import decode
from device_agent.protocol.events import Event
from device_agent.runtime.recording import format as recording_format

TIMELINE: Final = "session"
"""Time since the start of the session."""
_QUANTITIES: Final = ("position", "commanded", "applied")
_LEVELS: Final = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_events = msgspec.json.Decoder(Event)


def create() -> ExportFormat:
    """The format."""
    return write


def write(request: ExportRequest) -> str:
    """Write one file; returns the number of its rows and images in words.

    Raises:
        ExportError: The recording cannot be read.
    """
    info = request.recording.info
    stream = rerun.RecordingStream("telescope", recording_id=f"{info.device}-{info.epoch}")
    stream.save(request.output)
    rows = images = 0
    for span_ns in request.spans_ns():
        rows += _write_rows(stream, request, span_ns)
        topics = (*request.cameras, recording_format.EVENTS)
        for entry in request.progress.count(request.recording.entries(span_ns, topics), "images and events"):
            stream.set_time(TIMELINE, duration=np.timedelta64(entry.time_ns - info.started_ns, "ns"))
            if entry.topic == recording_format.EVENTS:
                event = decode(_events, entry)
                text = f"{event.kind}: {event.message}"
                stream.log("events", rerun.TextLog(text, level=_LEVELS[event.severity]))
            else:
                image = read_image(entry)
                content = rerun.EncodedImage(contents=image.data, media_type=f"image/{image.format}")
                stream.log(entry.topic.removeprefix("/"), content)
                images += 1
    stream.flush()
    stream.disconnect()
    return f"{rows} control rows and {images} images"


def _write_rows(stream: "rerun.RecordingStream", request: ExportRequest, span_ns: tuple[int, int]) -> int:
    """Write the rows of one span; returns their number. A value that is not a number interrupts the line at a gap."""
    joints, started_ns = request.recording.info.joints, request.recording.info.started_ns
    times, values, count = array("q"), array("d"), 0
    for row in request.progress.count(request.recording.rows(span_ns), "control rows"):
        if row.after_gap:
            times.append(times[-1] + 1)
            values.extend([np.nan] * len(_QUANTITIES) * len(joints))
        times.append(row.time_ns - started_ns)
        control = row.control
        for vector in (control.position_rad, control.commanded_rad, control.applied_rad):
            values.extend(vector)
        count += 1
    if not count:
        return 0
    index = rerun.TimeColumn(TIMELINE, duration=np.array(times, dtype="timedelta64[ns]"))
    table = np.array(values).reshape(len(times), len(_QUANTITIES), len(joints))
    for number, quantity in enumerate(_QUANTITIES):
        for joint, name in enumerate(joints):
            columns = rerun.Scalars.columns(scalars=table[:, number, joint])
            stream.send_columns(f"joints/{name}/{quantity}", indexes=[index], columns=columns)
    return count
