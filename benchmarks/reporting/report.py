"""What a suite has found: tables, charts and claims, kept as JSON. The page and the terminal show nothing else."""

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
"""Where short runs leave what they found; not kept with the sources."""
Cell = str | float | int | None


class Table(msgspec.Struct, frozen=True, kw_only=True):
    """Rows below a head. Numbers are shown with three digits."""

    title: str
    columns: list[str]
    rows: list[list[Cell]]
    note: str = ""


class Chart(msgspec.Struct, frozen=True, kw_only=True):
    """Lines, or bars beside each other, over the same places.

    Attributes:
        kind: ``line``, ``bar``, ``cdf``: shares of the samples of each series, which are not paired with ``x``, or
            ``waterfall``: parts that follow each other, each beginning where the one above it ends.
        x: Places, numbers or names.
        series: Name → values.
        marks: Name → a value to compare with, drawn as a dashed line.
    """

    title: str
    kind: str
    x_label: str
    y_label: str
    x: list[str | float]
    series: dict[str, list[float | None]]
    marks: dict[str, float] = msgspec.field(default_factory=dict)
    log: bool = False


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """What Telescope wants to hold, and what was seen.

    Attributes:
        text: The claim.
        seen: The figure.
        bound: ``seen`` may be as large as this, or with ``at_least`` as small.
        unit: Of both; a ratio's is ``×``.
    """

    text: str
    seen: float
    bound: float
    unit: str
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the figure is on the right side of its bound."""
        return self.seen >= self.bound if self.at_least else self.seen <= self.bound

    def line(self) -> str:
        """For a terminal and a page."""
        sign = "≥" if self.at_least else "≤"
        return f"{self.text}: {self.seen:.3g} {self.unit} (wanted {sign} {self.bound:g})"


class Report(msgspec.Struct, kw_only=True):
    """One suite's run.

    Attributes:
        suite: Its name, which is its file's too.
        about: Paragraphs: what was done, and how it is to be read.
        quick: Whether it was the short run.
        load: Of the machine over the minute before, from its other programs: 0 on a quiet one.
    """

    suite: str
    title: str
    about: list[str]
    quick: bool
    claims: list[Claim] = msgspec.field(default_factory=list)
    tables: list[Table] = msgspec.field(default_factory=list)
    charts: list[Chart] = msgspec.field(default_factory=list)
    made: str = msgspec.field(default_factory=lambda: time.strftime("%Y-%m-%d %H:%M", time.gmtime()))
    machine: str = msgspec.field(
        default_factory=lambda: (
            f"{os.cpu_count()} cores ({platform.machine()}), {platform.system()}, Python {platform.python_version()}"
        )
    )
    load: float = msgspec.field(default_factory=lambda: round(os.getloadavg()[0], 1))


def save(report: Report, folder: Path = RESULTS) -> Path:
    """Write it down, in place of what was found before."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{report.suite}.json"
    text = json.dumps(msgspec.to_builtins(report), indent=1, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def load(suite: str, folder: Path = RESULTS) -> Report | None:
    """What a suite has found last, if it has run."""
    path = folder / f"{suite}.json"
    return msgspec.json.decode(path.read_bytes(), type=Report) if path.exists() else None


def percentile(samples: Sequence[float], share: float) -> float:
    """The sample below which this share of them lies. Raises: ValueError: There is none."""
    if not samples:
        raise ValueError("no sample")
    ordered = sorted(samples)
    return ordered[min(round(share * (len(ordered) - 1)), len(ordered) - 1)]


def format_cell(value: Cell) -> str:
    """A cell as text: three digits, no more."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"  # noqa: PLR2004 (three digits)
    return f"{value:,}" if isinstance(value, int) else value
