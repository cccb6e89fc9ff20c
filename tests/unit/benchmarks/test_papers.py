"""What the papers printed is what their figures are compared with, and ratios are to the fastest other way."""

import statistics

from benchmarks.papers import figure5, figure6, table2
from benchmarks.papers.exchanges import SETPOINT
from benchmarks.papers.table2 import EMBEDDED, OURS, Condition
from benchmarks.reporting.report import Report


def test_table_2_is_as_printed() -> None:
    assert len(table2.HTTP) == len(table2.XMPP) == 20
    assert statistics.fmean(table2.HTTP) == 2994.6
    assert statistics.fmean(table2.XMPP) == 824.25


def test_a_setpoint_is_about_as_long_as_in_the_facts() -> None:
    assert 120 <= len(SETPOINT) <= 260


def test_ours_is_compared_with_the_fastest_that_is_not_mqtt() -> None:
    taken = {OURS: [2.0], EMBEDDED: [1.0], "XMPP, Prosody": [4.0], "WebSocket, JSON relay": [3.0]}
    claim = table2.claim(Condition(15, 0.0, 1), taken)
    assert claim.seen == 2.0 / 3.0
    assert claim.holds
    assert "WebSocket" in claim.text
    slower = table2.claim(Condition(15, 0.0, 1), {**taken, OURS: [3.3]})
    assert not slower.holds


def test_quick_and_whole_runs_have_every_round_trip() -> None:
    for quick in (True, False):
        found = table2.conditions(quick=quick)
        assert [each.rtt_ms for each in found if not each.loss] == [0, 15, 30, 100]
    assert {each.rtt_ms for each in found if each.loss} == {15, 30, 100}, "without a network nothing is lost"


def told() -> Report:
    return Report(suite="papers", title="T", about=[], quick=True)


def test_fig_6_claims_the_mean_and_the_worst_of_the_announcement() -> None:
    report = told()
    figure6.judge(report, {figure6.ANNOUNCED: [16.0, 18.0, 41.0], "another": [99.0]})
    mean, worst = report.claims
    assert (mean.seen, mean.holds) == (25.0, False)
    assert (worst.seen, worst.holds) == (41.0, False)
    assert report.tables[0].rows[0][2:5] == [63.0, 36.0, 103.0]


def test_fig_5_claims_every_robot_far_away_and_no_laboratory() -> None:
    report = told()
    found: figure5.Found = {}
    for robot in figure5.ROBOTS:
        for what in (figure5.SCRIPT, figure5.ACTION, figure5.SETPOINT):
            slow = 60.0 if what == figure5.SCRIPT and robot.name == "nao" else 24.0
            found[robot.label, what, figure5.RTT_MS] = [figure5.Sample(slow, slow + 10)] * 3
            found[robot.label, what, 0] = [figure5.Sample(1.0, 2.0)]
        found[f"{robot.label}, {figure5.LABORATORY}", figure5.ACTION, figure5.RTT_MS] = [figure5.Sample(500.0, 500.0)]
    figure5.show(report, found)
    assert [claim.seen for claim in report.claims] == [24.0] * 5 + [60.0]
    assert [claim.holds for claim in report.claims] == [True] * 5 + [False]
    assert report.charts[0].series[figure5.SCRIPT] == [24.0, 60.0, 24.0, 24.0]
