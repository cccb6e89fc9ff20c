"""The fault benchmark finds lost and repeated actions, and measures from Stop to rest."""

import math
import socket
from pathlib import Path

import pytest

from benchmarks.faults.action_load import (
    STEP_RAD,
    ActionLoad,
    RequestedAction,
    count_returns,
    duplicated,
    false_results,
    lost,
    rests,
)
from benchmarks.faults.fault_runs import FaultResult
from benchmarks.faults.kills import Kill, KillLoad, Verdict
from benchmarks.faults.recorder import Period, Recorder
from benchmarks.faults.stops import CALL, MESSAGE, SPEEDS, StopResult, evaluate
from benchmarks.suites.faults import Counts, claims, faults_table, stops_table
from benchmarks.suites.kills import report as kills_report
from tests.faults.judge import Row
from tests.harness.network.brokers import wait_until


def requested(number: int, status: str) -> RequestedAction:
    return RequestedAction(number, "none", 0.0, f"a{number}" if status else "", status)


def test_unfinished_accepted_actions_are_lost_and_actions_with_two_starts_are_duplicated() -> None:
    actions = [requested(1, "done"), requested(2, "started"), requested(3, ""), requested(4, "expired")]
    assert lost(actions) == [actions[1]]
    assert duplicated(actions, {"a1": 1, "a4": 2}) == [actions[3]]


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ((1, 1.4, 2, 3), 0),
        ((1, 2, 3, 2, 4), 1),
        ((1, 0, 1, 2), 1),  # an action that a restarted agent runs again
        ((5, 6, 0, 7), 0),  # a restarted simulation begins at zero
    ],
)
def test_a_return_to_an_earlier_target_is_counted(steps: tuple[float, ...], count: int) -> None:
    targets_rad = {number: number * STEP_RAD for number in range(1, 10)}
    trace = [Row(0.0, (0.7, number * STEP_RAD)) for number in steps for _ in range(5)]
    assert count_returns(number for _, number in rests(trace, targets_rad)) == count


def test_targets_stay_within_the_range_of_the_wrist_for_a_full_run() -> None:
    assert ActionLoad.target_rad(30_000) < math.tau
    assert KillLoad.target_rad(2_000) < math.tau


def test_positions_on_the_way_are_not_targets() -> None:
    trace = [Row(10.0 * each, (each * 1e-4,)) for each in range(100)]
    trace += [Row(2000.0 + 10 * each, (5 * STEP_RAD,)) for each in range(4)]
    assert list(rests(trace, {number: number * STEP_RAD for number in range(1, 10)})) == [(2020.0, 5)]


def test_results_that_differ_from_the_trace_are_false() -> None:
    actions = [requested(number, status) for number, status in enumerate(("done", "done", "failed", "expired"), 1)]
    reached_ms = {1: 1000.0, 3: 3000.0, 4: 4000.0}
    assert [each.partition(" is ")[0] for each in false_results(actions, reached_ms, [])] == [
        "action 2",
        "action 3",
        "action 4",
    ]
    # The agent was killed between the end of the motion and the record of the result.
    assert len(list(false_results(actions, reached_ms, [3100.0, 3700.0]))) == 2


def test_kills_with_a_slow_recovery_or_a_lost_action_fail_their_claims() -> None:
    kills = {"amqtt": [Kill(program="worker", at_ms=0.0, killed_ms=0.0, recovery_s=each) for each in (1.0, math.inf)]}
    verdict = Verdict(accepted=9, lost=1, duplicated=0, false=["action 1"])
    report = kills_report(kills, {"amqtt": verdict}, quick=True)
    assert [claim.holds for claim in report.claims] == [False, True, False, False]
    assert [row[:4] for row in report.tables[0].rows] == [["worker", "amqtt", 2, 1.0], ["any program", "amqtt", 2, 1.0]]


def stopped(*moved: float, braking_from: int, method: str = MESSAGE, speed: str = "full speed") -> StopResult:
    before = [Period(992.0, "streaming", 0.008, 1, 1)]
    after = [
        Period(1008.0 + 8 * index, "stopped" if index >= braking_from else "streaming", each, 1, 1)
        for index, each in enumerate(moved)
    ]
    return evaluate(before, after, sent_ms=1000.0, broker="amqtt", method=method, speed=speed)


@pytest.mark.parametrize(
    ("moved", "zero_ms"),
    [
        ((0.008, 0.006, 0.003, 0.0, 0.0), 32.0),
        ((0.008, 0.0, 0.002, 0.0, 0.0), 32.0),  # a reversal is not rest
        ((0.0, 0.0, 0.0), 16.0),
    ],
)
def test_stops_are_measured_to_braking_and_to_rest(moved: tuple[float, ...], zero_ms: float) -> None:
    result = stopped(*moved, braking_from=1)
    assert (result.braking_ms, result.zero_ms, result.at_rad_s) == (16.0, zero_ms, 1.0)


def test_motion_after_a_stop_fails_the_claim_of_rest() -> None:
    results = [
        FaultResult(fault="x", broker="amqtt", stop_ms=280.0, recovery_s=1.0, moved_again=again)
        for again in (False, True)
    ]
    stops = [
        stopped(0.0, 0.0, braking_from=0, method=method, speed=speed) for method in (MESSAGE, CALL) for speed in SPEEDS
    ]
    actions = {("amqtt", "x"): Counts(10, 0, 1, 0)}
    holds = {claim.text.partition(",")[0]: claim.holds for claim in claims(results, stops, actions)}
    assert not holds["last fresh setpoint → zero commanded velocity"]
    assert holds["lost"]
    assert not holds["duplicated: actions executed twice"]
    assert [row[-2] for row in faults_table(results, actions).rows] == [1]
    assert not faults_table(results, actions, least_rounds=3).rows, "a row with fewer rounds is not published"
    assert len(stops_table(stops).rows) == len(stops)


def test_the_recorder_receives_periods_of_the_agent(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for text in ("started arm1 x", "period arm0 10.5 streaming 0.001 3 7", "period arm0 18.5 stopped 0.002 3 7"):
            sender.sendto(text.encode(), str(tmp_path / "s"))
    wait_until(lambda: len(recorder.since("arm0", 0.0)) > 1, "two periods")
    assert recorder.starts == {"x": 1}
    assert recorder.since("arm0", 11.0) == [Period(18.5, "stopped", 0.002, 3, 7)]
    assert [row.target_rad for row in recorder.rows("arm0", 0.0)] == [(0.001,), (0.003,)]
    recorder.close()
