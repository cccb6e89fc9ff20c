"""Files of recordings, and their deletion by age and size.

``{device}/{epoch}/{segment}.mcap`` is a complete segment, ``.overview.json`` its overview, ``.uploaded`` marks that the
cloud has both, and ``.live`` is a segment that is being written or that a crash has left.
"""

import contextlib
import io
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from device_agent.runtime.recording.messages import RecordingLimits

_SEGMENT = re.compile(r"\A(\d{4,})\.(?:mcap|live)\Z")
_COMPLETE, _UPLOADED = ".mcap", ".uploaded"
_CLOCK_STEP_NS = 1_000_000_000
"""Two changes within this time may have the same time of change, because file systems use a coarse clock [ns]."""
_OWNER = "owner"
MODE, FOLDER_MODE = 0o600, 0o700


@dataclass(frozen=True, slots=True)
class StoredSegment:
    """A complete segment.

    Attributes:
        path: The MCAP file.
        device: Name of the device.
        epoch: Epoch of the session.
        segment: Number of the segment.
        size: Size of all its files [bytes].
        uploaded: Whether the cloud has it.
        at_s: When it was completed, on the wall clock [s since 1970].
    """

    path: Path
    device: str
    epoch: int
    segment: int
    size: int
    uploaded: bool
    at_s: float


class RecordingFolder:
    """The recordings of one agent. The constructor does not access the disk."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._settled: dict[str, int] = {}
        """Folder of a session → time of its last change when all its segments were uploaded [ns]."""

    def claim(self, owner: str) -> None:
        """Delete recordings of a former owner. ``owner``: space and account of the present one.

        Raises:
            OSError: They cannot be deleted, or the disk is full.
        """
        marker = self.folder / _OWNER
        if self.folder.is_dir() and (not marker.exists() or marker.read_text(encoding="utf-8") != owner):
            shutil.rmtree(self.folder)
        self.folder.mkdir(mode=FOLDER_MODE, exist_ok=True)
        if not marker.exists():
            write_file(marker, lambda file: file.write(owner.encode()))

    def live_path(self, device: str, epoch: int, lowest: int) -> Path:
        """Path for a new segment after all others of the session, with the number ``lowest`` or a higher one.

        Raises:
            OSError: The folder cannot be created.
        """
        folder = self.folder / device / f"{epoch:010}"
        for each in (self.folder, folder.parent, folder):
            each.mkdir(mode=FOLDER_MODE, exist_ok=True)
        numbers = [int(match[1]) for path in folder.iterdir() if (match := _SEGMENT.match(path.name))]
        return folder / f"{max([lowest, *(number + 1 for number in numbers)]):04}.live"

    def live(self) -> list[Path]:
        """Segments that are not complete, oldest first."""
        return sorted(self.folder.glob("*/*/*.live"))

    def segments(self) -> list[StoredSegment]:
        """Complete segments, oldest first."""
        return _stored(each for session in self._sessions() for each in _complete(session))

    def waiting(self) -> list[StoredSegment]:
        """Complete segments that are not uploaded, oldest first.

        The agent calls this every few seconds, so a session whose segments are uploaded is read again only after its
        folder has changed.
        """
        found, settled = [], {}
        for session in self._sessions():
            with contextlib.suppress(FileNotFoundError):
                changed_ns = os.stat(session).st_mtime_ns  # noqa: PTH116 (without a Path for each session)
                if self._settled.get(session) != changed_ns:
                    complete = [each for each in _complete(session) if not each[1]]
                    found += complete
                    if complete or time.time_ns() - changed_ns < _CLOCK_STEP_NS:
                        continue
                settled[session] = changed_ns
        self._settled = settled
        return _stored(found)

    def _sessions(self) -> Iterator[str]:
        for device in _subfolders(self.folder):
            yield from _subfolders(device)

    def pending(self, device: str, epoch: int) -> tuple[int, ...]:
        """Numbers of the segments of a session that are not uploaded, also those that are being written or sealed."""
        folder = self.folder / device / f"{epoch:010}"
        paths = [*folder.glob("*.mcap"), *folder.glob("*.live")]
        return tuple(sorted({int(path.stem) for path in paths if not uploaded_of(path).exists()}))

    def free_bytes(self) -> int:
        """Free space of the disk [bytes]."""
        return shutil.disk_usage(self.folder).free

    def enforce(self, limits: RecordingLimits, *, now_s: float) -> int:
        """Delete segments that are too old or beyond the size, uploaded ones first.

        A disk that is almost full ends the deletion of uploaded segments only: the only copy is not deleted because
        another program needs space.

        Args:
            limits: Limits.
            now_s: Wall clock [s since 1970].

        Returns:
            Number of deleted segments that were not uploaded.

        Raises:
            OSError: A file cannot be deleted.
        """
        lost, kept = 0, []
        used, oldest_s = self._used()
        due = used > limits.max_bytes or now_s - oldest_s > limits.max_age_s
        if not due and self.free_bytes() >= limits.min_free_bytes:
            return 0
        for each in self.segments():
            if now_s - each.at_s > limits.max_age_s:
                delete(each.path)
                lost += not each.uploaded
            else:
                kept.append(each)
        used, _ = self._used()
        for each in sorted(kept, key=lambda each: not each.uploaded):
            full = each.uploaded and self.free_bytes() < limits.min_free_bytes
            if used <= limits.max_bytes and not full:
                continue
            delete(each.path)
            used -= each.size
            lost += not each.uploaded
        return lost

    def used_bytes(self) -> int:
        """Size of all recordings [bytes]."""
        return self._used()[0]

    def _used(self) -> tuple[int, float]:
        """Size of all recordings [bytes], and when the oldest segment was completed [s since 1970].

        Called for each new segment, so it makes no list of all segments.
        """
        used, oldest_s = 0, float("inf")
        for session in self._sessions():
            for name in _names(session):
                with contextlib.suppress(FileNotFoundError):  # deleted, or completed, meanwhile
                    status = os.stat(f"{session}/{name}")  # noqa: PTH116 (without a Path for each file)
                    used += status.st_size
                    if name.endswith(_COMPLETE):
                        oldest_s = min(oldest_s, status.st_mtime)
        return used, oldest_s


def overview_of(segment: Path) -> Path:
    """Path of the overview of a segment."""
    return segment.with_suffix(".overview.json")


def uploaded_of(segment: Path) -> Path:
    """Path of the file that marks a segment as uploaded."""
    return segment.with_suffix(_UPLOADED)


def delete(segment: Path) -> None:
    """Delete the files of a segment, and its folders if they are empty.

    Raises:
        OSError: A file cannot be deleted.
    """
    for path in (segment, overview_of(segment), uploaded_of(segment)):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty
        segment.parent.rmdir()
        segment.parent.parent.rmdir()


def create(path: Path) -> int:
    """Create a file for this user only; returns its descriptor.

    Raises:
        OSError: It exists, or cannot be created.
    """
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, MODE)


def _subfolders(folder: Path | str) -> list[str]:
    with contextlib.suppress(FileNotFoundError), os.scandir(folder) as entries:
        return [entry.path for entry in entries if entry.is_dir()]
    return []


def _names(session: str) -> set[str]:
    with contextlib.suppress(FileNotFoundError):
        return set(os.listdir(session))  # noqa: PTH208 (without a Path for each file)
    return set()


def _complete(session: str) -> Iterator[tuple[str, bool]]:
    """Path of each complete segment, and whether it is uploaded."""
    names = _names(session)
    for name in names:
        if name.endswith(_COMPLETE):
            yield f"{session}/{name}", name.removesuffix(_COMPLETE) + _UPLOADED in names


def _stored(complete: Iterable[tuple[str, bool]]) -> list[StoredSegment]:
    found = []
    for name, uploaded in complete:
        path = Path(name)
        with contextlib.suppress(FileNotFoundError, ValueError):
            status, overview = path.stat(), overview_of(path)
            size = status.st_size + (overview.stat().st_size if overview.exists() else 0)
            device, epoch, segment = path.parent.parent.name, int(path.parent.name), int(path.stem)
            found.append(StoredSegment(path, device, epoch, segment, size, uploaded, status.st_mtime))
    return sorted(found, key=lambda each: (each.at_s, each.device, each.epoch, each.segment))


def write_file(path: Path, write: Callable[[io.BufferedWriter], object]) -> None:
    """Write a file completely or not at all, also if the machine loses power.

    Raises:
        OSError: The disk failed or is full.
    """
    temporary = path.with_name(f"{path.name}.new")
    temporary.unlink(missing_ok=True)
    try:
        with os.fdopen(create(temporary), "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
