"""Selects rows and images for the frames of a dataset with a fixed rate.

A frame gets the newest row, and of each camera the newest image, that are not later than the frame. No frame is made in
a gap of the rows, or when the newest image is too old: there an episode ends, and the next one begins.
"""

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device_agent.cli.export.request import ExportRequest

IMAGE_AGE_S = 1.0
"""Maximum age of an image in a frame [s]. A camera without a newer image has lost its connection."""
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, kw_only=True, slots=True)
class Samples:
    """Frames of one episode of the dataset, n of them.

    Attributes:
        time_ns: Log time of each frame, shape (n,) [ns since 1970].
        row: Sequence number of the row of each frame, shape (n,).
        state: Measured positions, shape (n, joints) [rad or m].
        action: Applied positions, shape (n, joints) [rad or m].
        images: Topic of a camera → log time of the image of each frame, shape (n,) [ns since 1970].
    """

    time_ns: NDArray[np.int64]
    row: NDArray[np.int64]
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    images: dict[str, NDArray[np.int64]]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Rows:
    """Consecutive rows without a gap, m of them; arrays as in ``Samples``."""

    time_ns: NDArray[np.int64]
    sequence: NDArray[np.int64]
    state: NDArray[np.float32]
    action: NDArray[np.float32]


def sample(request: ExportRequest, span_ns: tuple[int, int], cameras: Sequence[str]) -> Iterator[Samples]:
    """Frames of one part of a session, one ``Samples`` for each time without a gap.

    Raises:
        ExportError: The recording cannot be read.
    """
    before_ns = (span_ns[0] - round(IMAGE_AGE_S * _SECOND_NS), span_ns[1])
    images: dict[str, array[int]] = {topic: array("q") for topic in cameras}
    if cameras:
        for entry in request.recording.entries(before_ns, cameras):
            images[entry.topic].append(entry.time_ns)
    image_ns = {topic: np.array(times, dtype=np.int64) for topic, times in images.items()}
    for rows in _parts(request, span_ns):
        yield from _frames(rows, image_ns, request.fps)


def _parts(request: ExportRequest, span_ns: tuple[int, int]) -> Iterator[_Rows]:
    joints = len(request.recording.info.joints)
    numbers, values = array("q"), array("d")
    for row in request.progress.count(request.recording.rows(span_ns), "control rows"):
        if row.after_gap:
            yield _rows(numbers, values, joints)
            numbers, values = array("q"), array("d")
        numbers.extend((row.time_ns, row.control.sequence))
        values.extend(row.control.position_rad)
        values.extend(row.control.applied_rad)
    if numbers:
        yield _rows(numbers, values, joints)


def _rows(numbers: "array[int]", values: "array[float]", joints: int) -> _Rows:
    integers = np.array(numbers, dtype=np.int64).reshape(-1, 2)
    floats = np.array(values, dtype=np.float64).reshape(-1, 2, joints).astype(np.float32)
    return _Rows(time_ns=integers[:, 0], sequence=integers[:, 1], state=floats[:, 0], action=floats[:, 1])


def _frames(rows: _Rows, image_ns: dict[str, NDArray[np.int64]], fps: int) -> Iterator[Samples]:
    start_ns, end_ns = int(rows.time_ns[0]), int(rows.time_ns[-1])
    count = (end_ns - start_ns) * fps // _SECOND_NS + 1
    time_ns = start_ns + np.arange(count, dtype=np.int64) * _SECOND_NS // fps
    images = {topic: _newest(times, time_ns) for topic, times in image_ns.items()}
    complete = np.ones(count, dtype=bool)
    for newest_ns in images.values():
        complete &= time_ns - newest_ns <= IMAGE_AGE_S * _SECOND_NS
    index = np.searchsorted(rows.time_ns, time_ns, side="right") - 1
    edges = np.flatnonzero(np.diff(complete, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2).tolist():
        chosen = slice(first, end)
        yield Samples(
            time_ns=time_ns[chosen],
            row=rows.sequence[index[chosen]],
            state=rows.state[index[chosen]],
            action=rows.action[index[chosen]],
            images={topic: newest_ns[chosen] for topic, newest_ns in images.items()},
        )


def _newest(times_ns: NDArray[np.int64], frame_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """The newest of the sorted times at or before each frame; a time in the far past if there is none."""
    index = np.searchsorted(times_ns, frame_ns, side="right")
    never = np.array([-(2**62)], dtype=np.int64)
    return np.concatenate((never, times_ns))[index]
