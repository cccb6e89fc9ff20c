"""Judges from the simulation trace whether an arm came to rest in time and stayed at rest."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

MOST_MS = 350.0
"""Limit [ms] from the last setpoint (or other permission to move) to zero commanded velocity."""
_STILL_RAD = 1e-8
"""Change between two rows of 10 ms that counts as rest, below any commanded velocity."""
_REST_ROWS = 10
"""Duration of rest: a reversal passes through zero, and a late control loop pauses shortly."""
_ROW_MS = 20.0
"""Rows are due every 10 ms; in a longer gap the agent's process did not run."""
_RELEASED_RAD_S = 0.03
_RELEASED_AFTER_MS = 140.0
"""Braking starts later than this. An arm that hardly moves by then had its slider released."""


class Row(NamedTuple):
    """One row of the trace: monotonic time and commanded positions."""

    tick_ms: float
    target_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Effect of one cut on one arm.

    Attributes:
        speed_rad_s: Speed of the fastest commanded joint at the cut.
        rest_ms: Time from the reference to the first row of rest; infinite without rest.
        cut_ms: Time from the cut to the first row of rest.
        starved_ms: Time in which the control loop was not scheduled: late rows, or rows without a
            new command of a moving arm (due every 8 ms). A property of the machine, not of the agent.
        moved_again: Whether a motion was commanded after rest.
        slider_released: Whether the arm hardly moved when braking would have started.
    """

    speed_rad_s: float
    rest_ms: float
    cut_ms: float
    starved_ms: float
    moved_again: bool
    slider_released: bool = False

    @property
    def in_motion(self) -> bool:
        return self.speed_rad_s > 0.05 and not self.slider_released

    @property
    def met_limit(self) -> bool:
        most_ms = MOST_MS + self.starved_ms + (_ROW_MS if self.starved_ms else 0.0)  # resolution of one or two rows
        return self.rest_ms <= most_ms and not self.moved_again


def judge(rows: list[Row], *, cut_ms: float, since_ms: float, watched: bool = True) -> Verdict:
    """Verdict on the motion from the cut to the end of ``rows``.

    Args:
        rows: Rows from shortly before the cut until an operator may move the arm again.
        cut_ms: Time of the cut [ms].
        since_ms: Time from which the arm had no permission to move [ms].
        watched: Whether the watchdog must detect the cut.
    """
    before = [row for row in rows if row.tick_ms <= cut_ms][-3:]
    speed = _speed(before[0], before[-1]) if len(before) > 1 else 0.0
    after = [row for row in rows if row.tick_ms > min(cut_ms, since_ms)]
    later = [row for row in after if row.tick_ms <= since_ms + _RELEASED_AFTER_MS][-3:]
    slider_released = watched and len(later) > 1 and _speed(later[0], later[-1]) < _RELEASED_RAD_S
    still = 0
    for index in range(1, len(after)):
        still = still + 1 if _same(after[index - 1], after[index]) else 0
        if still >= _REST_ROWS and after[index - still].tick_ms > cut_ms:
            rest = after[index - still]
            moved_again = not all(_same(rest, later) for later in after[index:])
            starved = _starved(after[: index - still + 1])
            return Verdict(speed, rest.tick_ms - since_ms, rest.tick_ms - cut_ms, starved, moved_again, slider_released)
    return Verdict(speed, math.inf, math.inf, 0.0, moved_again=True, slider_released=slider_released)


class Record:
    """Reader of a growing trace file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._incomplete = b""
        self.rows: list[Row] = []

    def read(self) -> list[Row]:
        """All rows since ``discard``."""
        lines = (self._incomplete + self._file.read()).split(b"\n")
        self._incomplete = lines.pop()
        for line in lines:
            row = json.loads(line)
            if "target" in row:
                self.rows.append(Row(row["tick_ms"], tuple(row["target"])))
        return self.rows

    def discard(self, before_ms: float) -> None:
        self.rows = [row for row in self.rows if row.tick_ms >= before_ms]

    def close(self) -> None:
        self._file.close()


def quantile(values: Iterable[float], share: float) -> float:
    """The quantile ``share`` of the values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(share * len(ordered)) - 1)] if ordered else math.nan


def _speed(first: Row, last: Row) -> float:
    seconds = (last.tick_ms - first.tick_ms) / 1000
    return max(abs(b - a) for a, b in zip(first.target_rad, last.target_rad, strict=True)) / seconds


def _same(one: Row, other: Row) -> bool:
    return all(abs(a - b) <= _STILL_RAD for a, b in zip(one.target_rad, other.target_rad, strict=True))


def _starved(rows: list[Row]) -> float:
    """Starved time in rows that end with the first row of rest."""
    total_ms = 0.0
    for row, later in pairwise(rows[:-1]):
        gap_ms = later.tick_ms - row.tick_ms
        total_ms += gap_ms if _same(row, later) else max(0.0, gap_ms - _ROW_MS)
    return total_ms
