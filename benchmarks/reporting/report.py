"""Result of one suite: tables, charts and targets, stored as JSON. The page and the terminal show only these."""

import json
import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

RESULTS: Final = Path(__file__).resolve().parents[1] / "results"
QUICK: Final = RESULTS / "quick"
"""Results of quick runs; not under version control."""
Cell = str | float | int | None


class Table(msgspec.Struct, frozen=True, kw_only=True):
    """One table. Numbers are shown with three digits."""

    title: str
    columns: list[str]
    rows: list[list[Cell]]
    note: str = ""


class Chart(msgspec.Struct, frozen=True, kw_only=True):
    """One chart: lines or grouped bars over common x values.

    Attributes:
        kind: ``line``, ``bar``, ``cdf`` (cumulative share of each series; ``x`` is unused) or ``waterfall``
            (consecutive parts; each bar starts where the previous one ends).
        x: Numbers or names.
        series: Name → values.
        marks: Name → reference value, drawn as a dashed line.
    """

    title: str
    kind: str
    x_label: str
    y_label: str
    x: list[str | float]
    series: dict[str, list[float | None]]
    marks: dict[str, float] = msgspec.field(default_factory=dict)
    log: bool = False


class Claim(msgspec.Struct, frozen=True, rename={"measured": "seen"}):
    """A target and its measured value.

    Attributes:
        text: What is measured.
        measured: Measured value.
        bound: Largest allowed value; the smallest one if ``at_least`` is set.
        unit: Unit of both values; ``×`` for a ratio.
    """

    text: str
    measured: float
    bound: float
    unit: str
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """True if the measured value meets the bound."""
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    def line(self) -> str:
        """Returns the target and the measured value as one line of text."""
        sign = "≥" if self.at_least else "≤"
        return f"{self.text}: {self.measured:.3g} {self.unit} (target {sign} {self.bound:g})"


class Report(msgspec.Struct, kw_only=True, rename={"created": "made"}):
    """Result of one run of a suite.

    Attributes:
        suite: Name of the suite and of its file.
        about: Paragraphs that describe the method and how to read the results.
        quick: True for a run with few samples.
        load: Load average of the machine over the minute before the run; 0 on an idle machine.
    """

    suite: str
    title: str
    about: list[str]
    quick: bool
    claims: list[Claim] = msgspec.field(default_factory=list)
    tables: list[Table] = msgspec.field(default_factory=list)
    charts: list[Chart] = msgspec.field(default_factory=list)
    created: str = msgspec.field(default_factory=lambda: time.strftime("%Y-%m-%d %H:%M", time.gmtime()))
    machine: str = msgspec.field(
        default_factory=lambda: (
            f"{os.cpu_count()} cores ({platform.machine()}), {platform.system()}, Python {platform.python_version()}"
        )
    )
    load: float = msgspec.field(default_factory=lambda: round(os.getloadavg()[0], 1))


def save(report: Report, folder: Path = RESULTS) -> Path:
    """Writes the report and replaces the previous one."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{report.suite}.json"
    text = json.dumps(msgspec.to_builtins(report), indent=1, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def load(suite: str, folder: Path = RESULTS) -> Report | None:
    """Returns the latest report of a suite, or None."""
    path = folder / f"{suite}.json"
    return msgspec.json.decode(path.read_bytes(), type=Report) if path.exists() else None


def percentile(samples: Sequence[float], share: float) -> float:
    """Returns the sample at a share (0 to 1) of the sorted samples.

    Raises:
        ValueError: There are no samples.
    """
    if not samples:
        raise ValueError("no sample")
    ordered = sorted(samples)
    return ordered[min(round(share * (len(ordered) - 1)), len(ordered) - 1)]


def format_cell(value: Cell) -> str:
    """Returns a cell as text with at most three digits."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"  # noqa: PLR2004 (three digits)
    return f"{value:,}" if isinstance(value, int) else value
