"""Measurements of both papers: Table 2 of the UR5 paper, Fig. 5 and 6 of Telescope v2."""

from collections.abc import Callable
from typing import Final

from benchmarks.papers import figure5, figure6, table2
from benchmarks.reporting.report import Report

_ABOUT: Final = """What the papers printed was measured over their networks and on their machines; here a program of its
own delays each direction of each connection by half of the round trip that is named, and where loss is named, that
share of the segments comes a retransmission time later (200 ms and a round trip, as on Linux), and so does all behind
it."""


def run(*, quick: bool, say: Callable[[str], None]) -> Report:
    """Runs the measurements of both papers."""
    report = Report(suite="papers", title="The papers' figures", quick=quick, about=[_ABOUT])
    table2.measure(report, quick=quick, say=say)
    figure5.measure(report, quick=quick, say=say)
    figure6.measure(report, quick=quick, say=say)
    return report
