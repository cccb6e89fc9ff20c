"""Memory, descriptors and threads of each process of the product, from ``/proc``."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Self

import msgspec

from benchmarks.scale.processes import family, parents

_PARTS: Final = (
    ("function_app serve", "functions"),
    ("function_app work", "worker"),
    ("infra.embedded_broker", "broker"),
    ("infra.mosquitto", "broker"),
    ("device_agent run", "agent"),
)
CHILDREN: Final = "agent's children"
STARTER: Final = "starter"
PARTS: Final = ("functions", "worker", "broker", "agent", CHILDREN, STARTER)
TOTAL: Final = "total without the agent's children"
_KB: Final = 1024


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """One part of the product at one time.

    Attributes:
        at_s: Time since the start of the load.
        processes: Number of processes; the other values are sums over them.
        rss_mb: Resident memory, including shared pages.
        own_mb: Anonymous memory (heap and stack), which a leak increases. Shared libraries and forks do not count.
    """

    at_s: float
    part: str
    processes: int
    rss_mb: float
    pss_mb: float
    own_mb: float
    descriptors: int
    threads: int


class ProcessWatcher:
    """Samples the processes of a product until the context ends.

    Args:
        root: Process id of the program that starts the others.
        every_s: Interval between samples.
        file: CSV file that receives each sample immediately, so that a killed run keeps its samples.
    """

    def __init__(self, root: int, *, every_s: float, file: Path) -> None:
        self._root = root
        self._every_s = every_s
        self._file = file
        self._started_s = time.monotonic()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.samples: list[Sample] = []

    def _run(self) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._file.open("w", encoding="utf-8") as output:
            print(",".join(Sample.__struct_fields__), file=output, flush=True)
            while not self._stopping.wait(self._every_s):
                for sample in sample_parts(self._root, time.monotonic() - self._started_s):
                    self.samples.append(sample)
                    print(",".join(map(str, msgspec.structs.astuple(sample))), file=output)
                output.flush()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()


def sample_parts(root: int, at_s: float) -> Iterator[Sample]:
    """Samples all parts now."""
    members: dict[str, list[int]] = {}
    for process, part in _family(root).items():
        members.setdefault(part, []).append(process)
    for part, processes in members.items():
        usages = [usage for each in processes if (usage := _usage(each)) is not None]
        if usages:
            rss, pss, own, descriptors, threads = map(sum, zip(*usages, strict=True))
            yield Sample(
                at_s=round(at_s, 1),
                part=part,
                processes=len(usages),
                rss_mb=round(rss / _KB, 3),
                pss_mb=round(pss / _KB, 3),
                own_mb=round(own / _KB, 3),
                descriptors=descriptors,
                threads=threads,
            )


def _family(root: int) -> dict[int, str]:
    """Returns the process ids of the product and the part of each."""
    parent_of, parts = parents(), {root: STARTER}
    for process in family(root)[1:]:  # parents come first
        parts[process] = _part(process, parts.get(parent_of.get(process, root), STARTER))
    return parts


def _part(process: int, parent: str) -> str:
    """Derives the part from the command line; children of the agent or the broker count as their parent."""
    try:
        command = Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        command = ""
    if parent in ("agent", CHILDREN):
        return CHILDREN
    if parent != STARTER:
        return parent
    return next((part for words, part in _PARTS if words in command), STARTER)


def _usage(process: int) -> tuple[int, int, int, int, int] | None:
    """Returns resident, proportional and anonymous memory [kB], descriptors and threads; None if it has ended."""
    folder = Path(f"/proc/{process}")
    try:
        rolled = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
        kb = {name: int(value.split()[0]) for name, value in rolled.items()}
        descriptors = len(list((folder / "fd").iterdir()))
        threads = len(list((folder / "task").iterdir()))
    except (OSError, ValueError):
        return None
    return kb["Rss"], kb["Pss"], kb["Anonymous"], descriptors, threads
