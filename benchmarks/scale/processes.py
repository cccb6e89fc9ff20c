"""Processor time and memory of a program and its children, from ``/proc``."""

import os
from pathlib import Path

_TICKS_S = os.sysconf("SC_CLK_TCK")


def parents() -> dict[int, int]:
    """Returns the parent of each process of this machine."""
    found: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except OSError:  # the process has ended
            continue
        found[int(stat.parent.name)] = int(fields[1])
    return found


def family(process: int) -> list[int]:
    """Returns a process and its descendants."""
    parent_of, found = parents(), [process]
    for each in found:
        found += [child for child, parent in parent_of.items() if parent == each]
    return found


def processor_s(process: int) -> float:
    """Returns the processor time of a process and its children [s]."""
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
    """Returns the proportional memory of a process and its children [MB]."""
    total = 0.0
    for each in family(process):
        try:
            rolled = Path(f"/proc/{each}/smaps_rollup").read_text(encoding="ascii")
        except OSError:
            continue
        total += float(rolled.partition("\nPss:")[2].split()[0]) / 1024
    return total
