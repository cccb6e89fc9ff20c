"""Measurements of both papers: Table 2 of the UR5 paper, Fig. 5 and 6 of Telescope v2."""

from collections.abc import Callable
from typing import Final

from benchmarks.papers import figure5, figure6, table2
from benchmarks.reporting.report import Report

_ABOUT: Final = """The published values were measured over the papers' networks and on their machines. Here, a proxy
delays each direction of each connection by half of the stated round trip. With packet loss, the stated share of the
segments arrives one retransmission time later (200 ms plus a round trip, as on Linux), and so do the segments behind
it."""


def run(*, quick: bool, log: Callable[[str], None]) -> Report:
    """Runs the measurements of both papers."""
    report = Report(suite="papers", title="Comparison with the papers", quick=quick, about=[_ABOUT])
    table2.measure(report, quick=quick, log=log)
    figure5.measure(report, quick=quick, log=log)
    figure6.measure(report, quick=quick, log=log)
    return report
