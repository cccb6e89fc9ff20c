"""``docs/results/benchmarks.md`` and its charts, from ``results/*.json`` and nothing else.

``python -m benchmarks.reporting.page [--check]`` writes the page, or fails when it is not what the results say.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from benchmarks import suites
from benchmarks.reporting.report import Chart, Report, Table, format_cell, load

ROOT: Final = Path(__file__).resolve().parents[2]
PAGE: Final = ROOT / "docs" / "results" / "benchmarks.md"
PICTURES: Final = ROOT / "docs" / "pictures" / "benchmarks"
_INSIDE: Final = 5
"""So many names at most fit into a chart; more stand beside it."""
_DASHES: Final = ("--", ":", "-.")
_HEAD: Final = """# Benchmarks

Made by `make bench` from `benchmarks/results/*.json`; do not edit. What is compared took turns in one run on one
machine, so ratios mean something and single figures little. `make bench-quick` prints the claims in some minutes.
What whole runs of the tests have shown is in [measured.md](measured.md).
"""


def text(reports: list[Report]) -> str:
    """The page."""
    parts = [_HEAD, "## Claims\n", *_claims(reports)]
    for report in reports:
        parts += _section(report)
    return "\n".join(parts).rstrip() + "\n"


def _claims(reports: list[Report]) -> Iterator[str]:
    yield "| | wanted | seen | suite |\n| --- | ---: | ---: | --- |"
    for report in reports:
        for claim in report.claims:
            sign = "≥" if claim.at_least else "≤"
            mark = "" if claim.holds else " **not reached**"
            wanted = f"{sign} {claim.bound:g} {claim.unit}"
            seen = f"{claim.seen:.3g} {claim.unit}{mark}"
            yield f"| {claim.text} | {wanted} | {seen} | [{report.suite}](#{_anchor(report)}) |"
    yield ""


def _anchor(report: Report) -> str:
    kept = "".join(each for each in report.title.lower() if each.isalnum() or each in " -")
    return kept.replace(" ", "-")


def _section(report: Report) -> Iterator[str]:
    run = f"`python -m benchmarks {report.suite}{' --quick' if report.quick else ''}`"
    yield f"## {report.title}\n"
    yield f"{run}, {report.made}, {report.machine}, load {report.load:g} before.\n"
    for paragraph in report.about:
        yield f"{paragraph}\n"
    for table in report.tables:
        yield _table(table)
    for number, chart in enumerate(report.charts):
        yield f"![{chart.title}](../pictures/benchmarks/{_file(report, number)})\n"


def _table(table: Table) -> str:
    lines = [
        f"**{table.title}**\n",
        "| " + " | ".join(table.columns) + " |",
        "| --- |" + " ---: |" * (len(table.columns) - 1),
        *("| " + " | ".join(map(format_cell, row)) + " |" for row in table.rows),
    ]
    return "\n".join(lines) + "\n" + (f"\n{table.note}\n" if table.note else "")


def _file(report: Report, number: int) -> str:
    return f"{report.suite}-{number + 1}.png"


def draw(report: Report) -> None:
    """The charts of one report as pictures."""
    import matplotlib as mpl  # only who makes pictures needs it

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    PICTURES.mkdir(parents=True, exist_ok=True)
    for number, chart in enumerate(report.charts):
        names = len(chart.series) + len(chart.marks)
        beside = names > _INSIDE
        figure, axes = plt.subplots(figsize=(9.6 if beside else 7.2, 3.6), layout="constrained")
        _plot(axes, chart)
        axes.set(title=chart.title, xlabel=chart.x_label, ylabel=chart.y_label)
        if chart.log:
            axes.set_yscale("log")
        for place, (name, value) in enumerate(chart.marks.items()):
            axes.axhline(value, linestyle=_DASHES[place % len(_DASHES)], linewidth=1, color="dimgrey", label=name)
        axes.grid(alpha=0.3)
        if beside:
            figure.legend(loc="outside right upper", fontsize="small")
        elif names > 1:
            axes.legend(fontsize="small")
        figure.savefig(PICTURES / _file(report, number), dpi=110, metadata={"Software": None})
        plt.close(figure)


def _plot(axes: Any, chart: Chart) -> None:
    if chart.kind == "waterfall":
        _waterfall(axes, chart)
        return
    if chart.kind == "bar":
        width = 0.8 / len(chart.series)
        for place, (name, values) in enumerate(chart.series.items()):
            at = [index + (place - (len(chart.series) - 1) / 2) * width for index in range(len(chart.x))]
            axes.bar(at, [value or 0.0 for value in values], width, label=name)
        axes.set_xticks(range(len(chart.x)), [str(each) for each in chart.x])
        return
    for name, values in chart.series.items():
        if chart.kind == "cdf":
            ordered = sorted(value for value in values if value is not None)
            axes.plot(ordered, [(index + 1) / len(ordered) for index in range(len(ordered))], label=name)
        else:
            axes.plot(chart.x, values, marker="o", markersize=3, label=name)


def _waterfall(axes: Any, chart: Chart) -> None:
    height = 0.8 / len(chart.series)
    for place, (name, values) in enumerate(chart.series.items()):
        widths = [value or 0.0 for value in values]
        left = [sum(widths[:index]) for index in range(len(widths))]
        at = [index + (place - (len(chart.series) - 1) / 2) * height for index in range(len(widths))]
        drawn = axes.barh(at, widths, height, left=left, label=name)
        axes.bar_label(drawn, labels=[f"{width:.2f}" for width in widths], padding=3, fontsize=7)
    axes.set_yticks(range(len(chart.x)), [str(each) for each in chart.x], fontsize=8)
    axes.margins(x=0.08)
    axes.invert_yaxis()


def reports() -> list[Report]:
    """What has been found, in the page's order."""
    return [found for name in suites.NAMES if (found := load(name)) is not None]


def write() -> None:
    """The page and its pictures."""
    found = reports()
    PAGE.write_text(text(found), encoding="utf-8")
    for report in found:
        draw(report)


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reporting.page", description=__doc__)
    parser.add_argument("--check", action="store_true", help="fail when the page is not what the results say")
    if parser.parse_args().check:
        if PAGE.read_text(encoding="utf-8") == text(reports()):
            return 0
        sys.stderr.write(
            "docs/results/benchmarks.md is not what benchmarks/results say; run `python -m benchmarks.reporting.page`\n"
        )
        return 1
    write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
