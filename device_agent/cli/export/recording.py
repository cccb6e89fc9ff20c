"""Reads the recording of a session from its segments."""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.segments import Entry, Segment, decode, open_segment, read_entries
from device_agent.runtime.recording import format as recording_format
from device_agent.runtime.recording.format import ControlRow, SegmentInfo

_COMPLETE, _LIVE = ".mcap", ".live"
"""Names of segments end with this, if they are complete, or if they are being written or a crash has left them."""
GAP_PERIODS = 2
"""Rows that are more than this number of control periods apart have a gap between them."""
_SAME = (
    "device", "epoch", "robot_type", "robot_type_version", "joints", "period_ms", "started_ns", "started_tick_ns"
)  # fmt: skip
"""Metadata that all segments of a session share."""
_rows = msgspec.json.Decoder(ControlRow, strict=True)
_WHOLE = (0, 2**63)


class Row(NamedTuple):
    """A control period, its log time [ns since 1970], and whether a gap precedes it."""

    time_ns: int
    control: ControlRow
    after_gap: bool


class Recording:
    """The segments of one session, in their order.

    Args:
        segments: Segments of one session.
        report: Called with each damage that is tolerated; ``None`` tolerates none.
    """

    def __init__(self, segments: Sequence[Segment], report: Callable[[str], None] | None = None) -> None:
        self._segments = sorted(segments, key=lambda segment: segment.info.segment)
        self._report = report
        self._damaged: set[Path] = set()
        self._spans: dict[Path, tuple[int, int]] = {}
        self._check()

    @property
    def info(self) -> SegmentInfo:
        """Metadata of the first segment."""
        return self._segments[0].info

    @property
    def cameras(self) -> tuple[str, ...]:
        """Topics of all cameras of the session."""
        return tuple(dict.fromkeys(topic for segment in self._segments for topic in segment.info.cameras))

    def time_ns(self, session_s: float) -> int:
        """Log time of a time since the start of the session [s]."""
        return self.info.started_ns + round(session_s * 1e9)

    def session_s(self, time_ns: int) -> float:
        """Time since the start of the session [s]."""
        return (time_ns - self.info.started_ns) / 1e9

    def entries(self, span_ns: tuple[int, int] = _WHOLE, topics: Iterable[str] | None = None) -> Iterator[Entry]:
        """Messages in the order of their log times, including both ends of ``span_ns``.

        Args:
            span_ns: First and last log time [ns since 1970].
            topics: Topics; ``None`` returns all.

        Raises:
            ExportError: A file is truncated or damaged, and this is not tolerated.
        """
        wanted = None if topics is None else frozenset(topics)
        for segment in self._segments:
            first_ns, last_ns = self._spans.get(segment.path, _WHOLE)
            if last_ns < span_ns[0] or first_ns > span_ns[1]:
                continue
            content = sorted(read_entries(segment, self._on_damage(segment.path)), key=lambda entry: entry.time_ns)
            if content:
                self._spans[segment.path] = (content[0].time_ns, content[-1].time_ns)
            for entry in content[bisect_left(content, span_ns[0], key=lambda entry: entry.time_ns) :]:
                if entry.time_ns > span_ns[1]:
                    break
                if wanted is None or entry.topic in wanted:
                    yield entry

    def rows(self, span_ns: tuple[int, int] = _WHOLE) -> Iterator[Row]:
        """Control periods in their order.

        Raises:
            ExportError: A file is truncated or damaged, or the rows are not those of one session in their order.
        """
        previous: ControlRow | None = None
        for entry in self.entries(span_ns, (recording_format.CONTROL,)):
            row = self._decode(entry)
            if previous is not None and row.sequence <= previous.sequence:
                raise ExportError(
                    f"{self._name} has row {row.sequence} after row {previous.sequence}; the files are not one session"
                )
            yield Row(entry.time_ns, row, previous is not None and self._is_gap(previous, row))
            previous = row

    def _is_gap(self, before: ControlRow, after: ControlRow) -> bool:
        periods = (after.tick_ns - before.tick_ns) / (self.info.period_ms * 1e6)
        return periods > GAP_PERIODS or after.sequence - before.sequence > GAP_PERIODS

    def _decode(self, entry: Entry) -> ControlRow:
        row = decode(_rows, entry)
        if row.epoch != self.info.epoch:
            raise ExportError(f"{self._name} has a row of epoch {row.epoch}; export each session on its own")
        joints = len(self.info.joints)
        if any(len(values) != joints for values in (row.position_rad, row.commanded_rad, row.applied_rad)):
            raise ExportError(f"{self._name} has a row without values for its {joints} joints")
        return row

    @property
    def _name(self) -> str:
        return f"the recording of {self.info.device} in epoch {self.info.epoch}"

    def _on_damage(self, path: Path) -> Callable[[ExportError], None] | None:
        if self._report is None:
            return None
        report = self._report

        def tolerate(_: ExportError) -> None:
            if path not in self._damaged:
                self._damaged.add(path)
                report(f"{path} is truncated or damaged; the messages after the damage are missing")

        return tolerate

    def _check(self) -> None:
        first = self._segments[0]
        for number, segment in enumerate(self._segments):
            for name in _SAME:
                value, expected = getattr(segment.info, name), getattr(first.info, name)
                if value != expected:
                    raise ExportError(
                        f"{segment.path} has {name} {value}, but {first.path} has {expected}; "
                        "export the files of one session of one device"
                    )
            previous = self._segments[number - 1].info.segment if number else -1
            if segment.info.segment == previous:
                raise ExportError(f"{segment.path} is segment {previous} once more; remove one of the two files")
            if segment.info.segment > previous + 1:
                self._tolerate_missing(previous + 1, segment.info.segment - 1)

    def _tolerate_missing(self, first: int, last: int) -> None:
        name = f"segment {first}" if first == last else f"segments {first} to {last}"
        if self._report is None:
            raise ExportError(f"{self._name} lacks {name}; add --readable to export the others")
        self._report(f"{self._name} lacks {name}; the export has a gap there")


def open_recording(paths: Sequence[Path], report: Callable[[str], None] | None = None) -> Recording:
    """The recording in these files, or in all segments of a folder.

    A folder of an agent can contain a segment that is not complete yet; it counts as truncated.

    Args:
        paths: Files, or one folder.
        report: Called with each damage that is tolerated; ``None`` tolerates none.

    Raises:
        ExportError: A file cannot be read, the files belong to different sessions, or a segment is missing.
    """
    files: list[Path] = []
    for path in paths:
        files += _segment_files(path) if path.is_dir() else [path]
    if not files:
        raise ExportError(f"{', '.join(map(str, paths))} contains no recording, that is, no file *.mcap")
    segments = []
    for path in files:
        try:
            segments.append(open_segment(path))
        except ExportError as error:
            if report is None:
                raise
            report(f"{error}; it is left out")
    if not segments:
        raise ExportError(f"{', '.join(map(str, paths))} contains no readable segment")
    return Recording(segments, report)


def _segment_files(folder: Path) -> list[Path]:
    complete = sorted(folder.glob(f"*{_COMPLETE}"))
    names = {path.stem for path in complete}
    return complete + [path for path in sorted(folder.glob(f"*{_LIVE}")) if path.stem not in names]
