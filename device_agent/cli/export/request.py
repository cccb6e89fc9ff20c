"""What an export format gets, and what it returns."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TextIO, TypeVar

from device_agent.cli.export.episodes import Episode
from device_agent.cli.export.recording import Recording

Item = TypeVar("Item")
_INTERVAL_S = 1.0


class Progress:
    """Prints one line a second during long work.

    Args:
        stream: Where the lines are printed.
        clock: Monotonic clock [s].
    """

    def __init__(self, stream: TextIO = sys.stderr, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._clock = stream, clock
        self._printed_s = clock()

    def show(self, text: str) -> None:
        """Print a line, unless one was printed within the last second."""
        if self._clock() - self._printed_s >= _INTERVAL_S:
            self._printed_s = self._clock()
            print(text, file=self._stream, flush=True)

    def count(self, items: Iterable[Item], name: str) -> Iterator[Item]:
        """The same items; prints how many were processed."""
        for number, item in enumerate(items):
            yield item
            self.show(f"{number + 1} {name}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportRequest:
    """One export.

    Attributes:
        recording: The session.
        episodes: Parts to export; empty for the whole session.
        output: Path of the new file or folder; it does not exist yet.
        fps: Frames a second, for formats with a fixed rate [Hz].
        cameras: Topics of cameras to export.
        task: Task of episodes without a label.
        progress: Prints the progress.
    """

    recording: Recording
    episodes: Sequence[Episode]
    output: Path
    fps: int = 30
    cameras: Sequence[str] = ()
    task: str = ""
    progress: Progress = field(default_factory=Progress)

    def spans_ns(self) -> list[tuple[int, int]]:
        """First and last log time of each episode [ns since 1970]; one span without limits for the whole session."""
        at = self.recording.time_ns
        return [(at(episode.start_s), at(episode.end_s)) for episode in self.episodes] or [(0, 2**63)]


class ExportFormat(Protocol):
    """Writes one export format; modules provide it as ``create()``."""

    def __call__(self, request: ExportRequest) -> str:
        """Write the export; returns what was written, in words.

        Raises:
            ExportError: The recording cannot be read, or has no content for this format.
        """
        ...
