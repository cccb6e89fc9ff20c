"""What a program costs, with all that it has started, from ``/proc``."""

import os
from pathlib import Path

_TICKS_S = os.sysconf("SC_CLK_TCK")


def family(process: int) -> list[int]:
    """A process and what descends from it."""
    parents: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        parents[int(stat.parent.name)] = int(fields[1])
    found = [process]
    for each in found:
        found += [child for child, parent in parents.items() if parent == each]
    return found


def processor_s(process: int) -> float:
    """Processor time that a process and its children have had [s]."""
    total = 0
    for each in family(process):
        try:
            stat = Path(f"/proc/{each}/stat").read_text(encoding="ascii", errors="replace")
        except OSError:
            continue
        fields = stat.rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / _TICKS_S


def resident_mb(process: int) -> float:
    """Memory of a process and its children [MB]; what several share counts once for each of them by its part."""
    total = 0.0
    for each in family(process):
        try:
            rolled = Path(f"/proc/{each}/smaps_rollup").read_text(encoding="ascii")
        except OSError:
            continue
        total += float(rolled.partition("\nPss:")[2].split()[0]) / 1024
    return total
